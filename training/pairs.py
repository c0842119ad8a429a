"""The pairs of one step: always the same for the same settings, step and photos."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from training.augmentation import augment
from training.homographies import flow_between, look, random_looks, strength_at
from training.parallax import Place, random_parallax
from training.photos import Photo
from training.sampler import random_pixels
from training.settings import Settings


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
        photos: for homographies.
        places: of synthetic rooms, for true parallax; may be empty.
        device: where the photos are and the pairs are made.
    """

    photos: tuple[Photo, ...]
    places: tuple[Place, ...]
    device: torch.device


def make_pairs(sources: Sources, settings: Settings, step: int) -> Pairs:
    """Make the pairs of a step. Nothing is remembered between steps: resuming needs no state."""
    rng = np.random.default_rng([settings.seed, step])
    strength = strength_at(step, settings.mild_steps)
    crop = settings.crop_px
    firsts, seconds, flows = [], [], []
    for _ in range(settings.batch):
        if rng.random() < settings.parallax_share:
            place = sources.places[rng.integers(len(sources.places))]
            first, second, flow = random_parallax(rng, place, crop)
        else:
            photo = sources.photos[rng.integers(len(sources.photos))]
            size = photo.levels[0].shape
            looks = random_looks(rng, (size[1], size[2]), crop, strength)
            first, second = (look(photo.levels, each, crop) for each in looks)
            flow = flow_between(*looks, crop, sources.device)
        firsts.append(first)
        seconds.append(second)
        flows.append(flow.to(sources.device))
    images = augment(torch.stack([*firsts, *seconds]), rng, strength)
    queries, distractors = (
        torch.from_numpy(
            random_pixels(rng, settings.batch, settings.queries_per_image, crop, settings.border_px)
        ).to(sources.device)
        for _ in range(2)
    )
    return Pairs(images, torch.stack(flows), queries, distractors)
