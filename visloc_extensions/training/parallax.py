"""Pairs with true parallax, from photographs of synthetic rooms with exact depth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import permutations
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load
from torch import Tensor

from samples.render import render_depth, render_photo
from samples.scene import make_room
from samples.trajectories import mapping_trajectory
from visloc.errors import NotFound, refuse
from visloc.geometry import Camera, Pose
from visloc_extensions.training.files import write_tensors
from visloc_extensions.training.homographies import Matrices, looks_at, moved, rotations_about

WIDTH_PX, HEIGHT_PX = 480, 360
_CAMERA = Camera("PINHOLE", WIDTH_PX, HEIGHT_PX, (360.0, 360.0, WIDTH_PX / 2, HEIGHT_PX / 2))
# Views of one place: how far apart at most.
_VIEWS_PER_PLACE = 3
_MAX_SHIFT_M = 0.35
_MAX_TURN_DEG = (8.0, 12.0, 25.0)  # about the camera's x, y and z
# Inverse depth is kept in 16 bits up to 4 per metre: 0.01 px of flow at the widest baseline.
_INVERSE_DEPTH_UNIT = 4.0 / 65535
_JPEG_QUALITY = 95
# A surface is seen by both cameras if its depths agree to this share; else something is before it.
_SAME_DEPTH = 0.01
_GOOD_SHARE, _MOST_TRIES = 0.6, 8
_SPOTS_PX = 16  # between spots that tell how much two crops share
# Looks at views: their pixels per crop pixel; and at full strength the second beside the first.
_SCALES = (0.6, 1.5)
_MAX_SCALE_CHANGE = 1.3
_MAX_TILT_DEG = 20.0
_MAX_TWIST_DEG = 20.0


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One photograph of a room.

    Attributes:
        image: (3, H, W) uint8.
        inverse_depth: (H, W) of the pixel centres, per metre along the optical axis; 0 where
            nothing is seen.
    """

    image: Tensor
    inverse_depth: NDArray[np.floating]
    cam_from_world: Pose
    camera: Camera = _CAMERA


Place = tuple[View, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Rooms:
    """Views of places, and which of them show the same place.

    Attributes:
        inverse_depth: (views, H, W) float32 on the device.
        intrinsics: (views, 4), fx, fy, cx, cy.
        pairs: (pairs, 2) views of one place.
        second_from_first: (pairs, 3, 4) rotations and translations.
        spots: (spots, 2) pixels, a grid over a view.
        seen: (pairs, spots, 2) where they are in the second view, NaN where they are hidden.
    """

    inverse_depth: Tensor
    intrinsics: NDArray[np.float64]
    pairs: NDArray[np.int64]
    second_from_first: NDArray[np.float64]
    spots: NDArray[np.float64]
    seen: NDArray[np.float64]


def make_rooms(places: Sequence[Place], device: torch.device) -> Rooms:
    """Put the views of all places, of one size, into one table."""
    views = [view for place in places for view in place]
    begins = np.cumsum([0, *(len(place) for place in places)]).tolist()
    pairs = np.array(
        [
            (begin + one, begin + other)
            for begin, place in zip(begins, places, strict=False)
            for one, other in permutations(range(len(place)), 2)
        ]
    )
    motions = [views[b].cam_from_world @ views[a].cam_from_world.inverse() for a, b in pairs]
    depths = torch.from_numpy(np.stack([view.inverse_depth for view in views]).astype(np.float32))
    second_from_first = np.stack([np.column_stack([m.rotation, m.translation]) for m in motions])
    intrinsics = np.array([view.camera.params for view in views])
    height, width = depths.shape[1:]
    x, y = np.meshgrid(np.arange(8.0, width, _SPOTS_PX), np.arange(8.0, height, _SPOTS_PX))
    spots = np.stack([x, y], axis=-1) + 0.5
    seen = [
        other_view(
            depths,
            torch.from_numpy(pairs[part]),
            torch.from_numpy(intrinsics[pairs[part]]),
            torch.from_numpy(second_from_first[part]),
            torch.from_numpy(spots).expand(len(pairs[part]), -1, -1, -1),
        ).numpy()
        for part in (slice(n, n + 64) for n in range(0, len(pairs), 64))
    ]
    return Rooms(
        depths.to(device),
        intrinsics,
        pairs,
        second_from_first,
        spots.reshape(-1, 2),
        np.concatenate(seen).reshape(len(pairs), -1, 2),
    )


def other_view(
    inverse_depth: Tensor,
    pairs: Tensor,
    intrinsics: Tensor,
    second_from_first: Tensor,
    points: Tensor,
) -> Tensor:
    """Return where pixels of first views are seen in second ones, NaN where they are not.

    Args:
        inverse_depth: (views, H, W) float32.
        pairs: (n, 2) int64, the first and the second view of each.
        intrinsics: (n, 2, 4) float64, fx, fy, cx, cy of both.
        second_from_first: (n, 3, 4) float64.
        points: (n, h, w, 2) float64 pixels (x, y) of the first views.

    Returns:
        (n, h, w, 2) float64.
    """
    fx, fy, cx, cy = intrinsics[:, 0, :, None, None].unbind(dim=1)
    x, y = (points[..., 0] - cx) / fx, (points[..., 1] - cy) / fy
    inverse = _depth_at(inverse_depth[pairs[:, 0]], points)
    turn = second_from_first[..., None, None]
    # Points times inverse depth: finite where nothing is seen.
    u, v, depth_ratio = (
        turn[:, row, 0] * x + turn[:, row, 1] * y + turn[:, row, 2] + turn[:, row, 3] * inverse
        for row in range(3)
    )
    in_front = (depth_ratio > 1e-6) & (inverse > 0)
    depth_ratio = torch.where(in_front, depth_ratio, 1.0)  # of second to first
    fx, fy, cx, cy = intrinsics[:, 1, :, None, None].unbind(dim=1)
    found = torch.stack([fx * u / depth_ratio + cx, fy * v / depth_ratio + cy], dim=-1)
    # Inverse depth is linear in the pixel on a plane: interpolating it is exact there.
    seen = _depth_at(inverse_depth[pairs[:, 1]], found)
    expected = inverse / depth_ratio
    visible = in_front & ((seen - expected).abs() < _SAME_DEPTH * expected)
    return torch.where(visible[..., None], found, torch.nan)


def _depth_at(inverse_depth: Tensor, points: Tensor) -> Tensor:
    """Return inverse depth (n, h, w) float64 of views (n, H, W) at pixels (n, h, w, 2)."""
    height, width = inverse_depth.shape[1:]
    x, y = points.unbind(dim=-1)
    grid = torch.stack([x / width, y / height], dim=-1) * 2 - 1
    # Far outside is as good as any other place outside.
    seen = F.grid_sample(
        inverse_depth[:, None],
        grid.clamp(-9, 9).float(),
        padding_mode="zeros",
        align_corners=False,
    )
    return seen[:, 0].double()


def random_views(
    rng: np.random.Generator, rooms: Rooms, count: int, crop_px: int, strength: float
) -> tuple[NDArray[np.int64], Matrices, Matrices]:
    """Return numbers of pairs (n,), and looks at both views, photo_from_crop (n, 3, 3) each.

    Of some tries for each the first is taken in which most of the first crop is in the second;
    else the best.
    """
    tries = count * _MOST_TRIES
    pair = rng.integers(len(rooms.pairs), size=tries)
    height, width = rooms.inverse_depth.shape[1:]
    size = np.array([width, height])
    lowest, highest = np.log(_SCALES)
    most = min(highest, np.log(0.95 * height / crop_px))
    scale = np.exp(rng.uniform(min(lowest, most), most, tries))
    change = np.exp(strength * np.log(_MAX_SCALE_CHANGE) * rng.uniform(-1, 1, tries))
    spot = rng.integers(len(rooms.spots), size=tries)
    shift = rng.uniform(-0.15, 0.15, (tries, 2)) * crop_px
    found = rooms.seen[pair, spot]
    targets = rooms.spots[spot], np.where(np.isnan(found), size / 2, found) + shift
    looks = []
    for target, zoom, tilt, turn in (
        (targets[0], scale, 0.0, 0.0),
        (targets[1], scale * change, _MAX_TILT_DEG * strength, _MAX_TWIST_DEG * strength),
    ):
        margin = np.minimum(0.5 * zoom[:, None] * crop_px, size / 2)
        inside = np.clip(target, margin, size - margin)
        looks.append(looks_at(rng, inside, zoom, crop_px, tilt_deg=tilt, turn_deg=turn))
    first, second = (
        moved(np.asarray(np.linalg.inv(look)), points)
        for look, points in zip(looks, (rooms.spots[None], rooms.seen[pair]), strict=True)
    )
    in_first, in_second = (((p >= 0) & (p < crop_px)).all(axis=2) for p in (first, second))
    share = (in_first & in_second).sum(axis=1) / np.maximum(in_first.sum(axis=1), 1)
    share = np.minimum(share, _GOOD_SHARE).reshape(count, _MOST_TRIES)
    best = share.argmax(axis=1) + np.arange(count) * _MOST_TRIES
    return pair[best], looks[0][best], looks[1][best]


def pack_rooms(output: Path, *, rooms: int, places: int, seed: int) -> int:
    """Photograph rooms, and return the number of photos. A photo takes most of a second.

    Args:
        rooms: how many, each with other pictures on the same furniture.
    """
    arrays: dict[str, NDArray[np.generic]] = {}
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as workers:
        for made in workers.map(_photographed, [seed] * rooms, range(rooms), [places] * rooms):
            arrays |= made
    write_tensors(output, arrays, {"rooms": rooms, "places": places, "seed": seed})
    return len(arrays) // 3


def _photographed(seed: int, room: int, places: int) -> dict[str, NDArray[np.generic]]:
    """Return what a pack holds of one room."""
    arrays: dict[str, NDArray[np.generic]] = {}
    rng = np.random.default_rng([seed, room])
    scene = make_room(seed + room)
    for place, near in enumerate(mapping_trajectory(places)):
        for view in range(_VIEWS_PER_PLACE):
            pose = _moved(rng) @ near
            name = f"{room:03}-{place:03}-{view}"
            rgb = render_photo(scene, _CAMERA, pose, rng)
            depth = render_depth(scene, _CAMERA, pose)
            units = np.zeros(depth.shape)
            np.divide(1 / _INVERSE_DEPTH_UNIT, depth, out=units, where=depth > 0)
            coded = np.clip(np.rint(units), 0, 65535).astype(np.uint16)
            arrays[f"{name}.image"] = _encoded(
                ".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
            )
            arrays[f"{name}.inverse_depth"] = _encoded(".png", coded, [])
            arrays[f"{name}.cam_from_world"] = np.column_stack([pose.rotation, pose.translation])
    return arrays


def _moved(rng: np.random.Generator) -> Pose:
    """Return a small motion of a camera, as new_from_old."""
    angles = np.deg2rad(rng.uniform(np.negative(_MAX_TURN_DEG), _MAX_TURN_DEG))
    about_x, about_y, about_z = rotations_about(np.eye(3), angles)
    rotation = about_z @ about_y @ about_x
    return Pose(rotation, -rotation @ rng.uniform(-_MAX_SHIFT_M, _MAX_SHIFT_M, 3))


def _encoded(suffix: str, image: NDArray[np.generic], options: list[int]) -> NDArray[np.uint8]:
    _, data = cv2.imencode(suffix, np.ascontiguousarray(image), options)
    return np.asarray(data, np.uint8).ravel()


def read_rooms(path: Path) -> tuple[Place, ...]:
    """Read what ``pack_rooms`` wrote."""
    if not path.is_file():
        raise refuse("training.rooms", field=str(path), kind=NotFound)
    try:
        packed = load(path.read_bytes())
        names = sorted(name.removesuffix(".image") for name in packed if name.endswith(".image"))
        places: dict[str, list[View]] = {}
        for name in names:
            places.setdefault(name.rpartition("-")[0], []).append(_view(packed, name))
    except (SafetensorError, ValueError, KeyError, cv2.error) as error:
        raise refuse(
            "training.rooms", f"the rooms cannot be read: {error}", field=str(path)
        ) from error
    return tuple(tuple(views) for views in places.values())


def _view(packed: Mapping[str, NDArray[Any]], name: str) -> View:
    bgr = cv2.imdecode(packed[f"{name}.image"], cv2.IMREAD_COLOR)
    units = cv2.imdecode(packed[f"{name}.inverse_depth"], cv2.IMREAD_UNCHANGED)
    if bgr is None or units is None:
        raise ValueError(f"{name} cannot be decoded")
    matrix = packed[f"{name}.cam_from_world"].reshape(3, 4)
    rgb = np.ascontiguousarray(bgr[..., ::-1].transpose(2, 0, 1))
    return View(
        torch.from_numpy(rgb),
        units.astype(np.float32) * np.float32(_INVERSE_DEPTH_UNIT),
        Pose(matrix[:, :3], matrix[:, 3]),
    )
