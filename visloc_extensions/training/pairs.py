"""The pairs of one step: always the same for the same settings, step and photos.

They are drawn as numbers on the processor, and made of these on the device by the same operations
in each step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from visloc_extensions.training.atlas import Atlas, levels_to_look_at, look, make_atlas
from visloc_extensions.training.augmentation import augment
from visloc_extensions.training.conditions import Conditions, draw_conditions
from visloc_extensions.training.homographies import (
    applied,
    pixel_centres,
    random_looks,
    strength_at,
)
from visloc_extensions.training.parallax import Place, Rooms, make_rooms, other_view, random_views
from visloc_extensions.training.photos import Photo, photo_levels
from visloc_extensions.training.sampler import random_pixels
from visloc_extensions.training.settings import Settings


class Pairs(NamedTuple):
    """What one step learns from.

    Attributes:
        images: (2 B, 3, H, W) in 0 to 1, all first images, then all second ones.
        flow: (B, H, W, 2).
        queries: (B, N, 2) int64 pixels (x, y) of the first images.
        distractors: (B, N, 2) int64 pixels of the second ones.
    """

    images: Tensor
    flow: Tensor
    queries: Tensor
    distractors: Tensor


@dataclass(frozen=True, slots=True, eq=False)
class Sources:
    """Where pairs come from.

    Attributes:
        atlas: the photos, for homographies, then the views of rooms.
        sizes: (photos, 2) heights and widths, without the views.
        rooms: for true parallax, None without.
        device: where the photos are and the pairs are made.
    """

    atlas: Atlas
    sizes: np.ndarray
    rooms: Rooms | None
    device: torch.device


def make_sources(photos: Sequence[Photo], places: Sequence[Place], device: torch.device) -> Sources:
    """Put photos and the views of places onto the device."""
    views = [
        Photo("view", photo_levels(view.image.permute(1, 2, 0).numpy()))
        for place in places
        for view in place
    ]
    atlas = make_atlas([*photos, *views], device)
    rooms = make_rooms(places, device) if places else None
    return Sources(atlas, atlas.sizes[: len(photos), 0], rooms, device)


class Drawn(NamedTuple):
    """Numbers that decide the pairs of a step: arrays, or tensors in float64.

    Attributes:
        begins: (2 B,) where the levels that are looked at begin, of first images, then second.
        sizes: (2 B, 2) their heights and widths.
        level_from_crop: (2 B, 3, 3).
        photo_from_first: (B, 3, 3).
        second_from_photo: (B, 3, 3).
        in_room: (B,) 1 for pairs of two views, 0 for two looks at one photo.
        views: (B, 2) of pairs in rooms.
        intrinsics: (B, 2, 4) of them.
        motion: (B, 3, 4) of them, second from first.
        queries: (B, N, 2) pixels.
        distractors: (B, N, 2) pixels.
    """

    begins: Any
    sizes: Any
    level_from_crop: Any
    photo_from_first: Any
    second_from_photo: Any
    in_room: Any
    views: Any
    intrinsics: Any
    motion: Any
    queries: Any
    distractors: Any


def draw(sources: Sources, settings: Settings, step: int) -> tuple[Drawn, Conditions]:
    """Draw the pairs of a step. Nothing is remembered between steps: resuming needs no state."""
    rng = np.random.default_rng([settings.seed, step])
    strength = strength_at(step, settings.mild_steps)
    crop, batch = settings.crop_px, settings.batch
    photo = rng.integers(len(sources.sizes), size=batch)
    first, second = random_looks(rng, sources.sizes[photo], crop, strength)
    looked_at = np.stack([photo, photo])
    in_room = rng.random(batch) < settings.parallax_share
    views, intrinsics = np.zeros((batch, 2), np.int64), np.ones((batch, 2, 4))
    motion = np.zeros((batch, 3, 4))
    if sources.rooms is not None and in_room.any():
        pair, one, other = random_views(rng, sources.rooms, int(in_room.sum()), crop, strength)
        first[in_room], second[in_room] = one, other
        views[in_room] = sources.rooms.pairs[pair]
        intrinsics[in_room] = sources.rooms.intrinsics[views[in_room]]
        motion[in_room] = sources.rooms.second_from_first[pair]
        looked_at[:, in_room] = len(sources.sizes) + views[in_room].T
    levels = levels_to_look_at(
        sources.atlas, looked_at.ravel(), np.concatenate([first, second]), crop
    )
    queries, distractors = (
        random_pixels(rng, batch, settings.queries_per_image, crop, settings.border_px)
        for _ in range(2)
    )
    drawn = Drawn(
        *levels,
        first,
        np.linalg.inv(second),
        in_room,
        views,
        intrinsics,
        motion,
        queries,
        distractors,
    )
    conditions = draw_conditions(
        rng, 2 * batch, strength, settings.night_share, settings.weather_share
    )
    return drawn, conditions


def make(sources: Sources, settings: Settings, drawn: Drawn, conditions: Conditions) -> Pairs:
    """Make pairs of what was drawn, tensors of float64 on the device."""
    clean = photograph(sources, settings, drawn)
    return clean._replace(images=augment(clean.images, conditions))


def photograph(sources: Sources, settings: Settings, drawn: Drawn) -> Pairs:
    """Make pairs of what was drawn before light, weather and cameras change them."""
    crop = settings.crop_px
    seen = look(
        sources.atlas.pixels,
        drawn.begins.long(),
        drawn.sizes.long(),
        drawn.level_from_crop,
        crop,
    )
    places = applied(drawn.photo_from_first, pixel_centres(crop, sources.device))
    if sources.rooms is not None:
        elsewhere = other_view(
            sources.rooms.inverse_depth,
            drawn.views.long(),
            drawn.intrinsics,
            drawn.motion,
            places,
        )
        places = torch.where(drawn.in_room[:, None, None, None] > 0, elsewhere, places)
    flow = applied(drawn.second_from_photo, places)
    # A comparison with NaN is false.
    inside = ((flow >= 0) & (flow < crop)).all(dim=-1, keepdim=True)
    return Pairs(
        seen,
        torch.where(inside, flow, torch.nan).float(),
        drawn.queries.long(),
        drawn.distractors.long(),
    )


def as_numbers(drawn: Drawn, conditions: Conditions) -> Tensor:
    """Return everything that was drawn as one vector of float64, which travels in one piece."""
    arrays = [np.asarray(each, np.float64).ravel() for each in (*drawn, *conditions)]
    return torch.from_numpy(np.concatenate(arrays))


def from_numbers(numbers: Tensor, like: tuple[Drawn, Conditions]) -> tuple[Drawn, Conditions]:
    """Return what ``as_numbers`` joined, as tensors of the shapes of another step's."""
    shapes = [np.shape(each) for each in (*like[0], *like[1])]
    parts = torch.split(numbers, [int(np.prod(shape)) for shape in shapes])
    tensors = [part.view(shape) for part, shape in zip(parts, shapes, strict=True)]
    return Drawn(*tensors[: len(Drawn._fields)]), Conditions(*tensors[len(Drawn._fields) :])


def make_pairs(sources: Sources, settings: Settings, step: int) -> Pairs:
    """Draw and make the pairs of a step."""
    like = draw(sources, settings, step)
    numbers = as_numbers(*like).to(sources.device)
    return make(sources, settings, *from_numbers(numbers, like))
