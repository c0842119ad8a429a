"""Pairs with true parallax, from photographs of synthetic rooms with exact depth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load
from torch import Tensor

from samples.render import render_depth, render_photo
from samples.scene import make_room
from samples.trajectories import mapping_trajectory
from training.files import write_tensors
from training.homographies import rotation_about
from visloc.errors import NotFound, refuse
from visloc.geometry import Camera, Pose

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


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One photograph of a room.

    Attributes:
        image: (3, H, W) uint8.
        inverse_depth: (H, W) of the pixel centres, per metre along the optical axis; 0 where
            nothing is seen.
        cam_from_world: its pose.
        camera: a PINHOLE.
    """

    image: Tensor
    inverse_depth: NDArray[np.floating]
    cam_from_world: Pose
    camera: Camera = _CAMERA


Place = tuple[View, ...]


def flow_to_view(first: View, second: View, left: int, top: int, side_px: int) -> Tensor:
    """Return where a square of the first view is seen in the second, NaN where it is not.

    Args:
        first: the square is ``left`` to ``left + side_px``, ``top`` to ``top + side_px`` of it.
        second: another view of the same room.
        left: column.
        top: row.
        side_px: of the square.

    Returns:
        (side_px, side_px, 2) float32 pixels (x, y) of the second view.
    """
    y, x = np.mgrid[top : top + side_px, left : left + side_px] + 0.5
    inverse = first.inverse_depth[top : top + side_px, left : left + side_px].astype(np.float64)
    fx, fy, cx, cy = first.camera.params
    rays = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)], axis=-1)
    second_from_first = second.cam_from_world @ first.cam_from_world.inverse()
    # Points times inverse depth: finite where nothing is seen.
    points = rays @ second_from_first.rotation.T
    points += inverse[..., None] * second_from_first.translation
    fx, fy, cx, cy = second.camera.params
    in_front = (points[..., 2] > 1e-6) & (inverse > 0)
    depth_ratio = np.where(in_front, points[..., 2], 1.0)  # of second to first
    flow = np.stack(
        [fx * points[..., 0] / depth_ratio + cx, fy * points[..., 1] / depth_ratio + cy], axis=-1
    )
    # Inverse depth is linear in the pixel on a plane: interpolating it is exact there.
    seen = cv2.remap(
        second.inverse_depth.astype(np.float32),
        np.where(in_front, flow[..., 0] - 0.5, -9.0).astype(np.float32),
        np.where(in_front, flow[..., 1] - 0.5, -9.0).astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=0.0,
    )
    expected = inverse / depth_ratio
    visible = in_front & (np.abs(seen - expected) < _SAME_DEPTH * expected)
    return torch.from_numpy(np.where(visible[..., None], flow, np.nan).astype(np.float32))


def random_parallax(
    rng: np.random.Generator, place: Place, crop_px: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Return crops (3, H, W) in 0 to 1 of two views of a place, and the flow (H, W, 2) on the CPU.

    Of some tries the first is taken in which most of the first crop is in the second; else the
    best.
    """
    best = (-1.0, 0, 0, 1, 0, 0, 0, torch.empty(0))
    for _ in range(_MOST_TRIES):
        one, other = rng.permutation(len(place))[:2].tolist()
        height, width = place[one].image.shape[1:]
        left, top = (int(rng.integers(size - crop_px + 1)) for size in (width, height))
        flow = flow_to_view(place[one], place[other], left, top, crop_px)
        known = flow[~flow[..., 0].isnan()]
        if not len(known):
            middle = torch.tensor([width / 2, height / 2])
        else:
            middle = known.median(dim=0).values
        shift = rng.uniform(-0.15, 0.15, 2) * crop_px
        # The centre of the crop on the middle of what is seen, moved a little, inside the view.
        x, y = (
            int(np.clip(round(float(m) + s - crop_px / 2), 0, size - crop_px))
            for m, s, size in zip(middle, shift, (width, height), strict=True)
        )
        flow = flow - torch.tensor([x, y], dtype=torch.float32)
        inside = ((flow >= 0) & (flow < crop_px)).all(dim=-1, keepdim=True)
        share = float(inside.float().mean())
        if share > best[0]:
            best = (share, one, other, left, top, x, y, torch.where(inside, flow, torch.nan))
        if share > _GOOD_SHARE:
            break
    _, one, other, left, top, x, y, flow = best
    first = place[one].image[:, top : top + crop_px, left : left + crop_px]
    second = place[other].image[:, y : y + crop_px, x : x + crop_px]
    return first.float() / 255, second.float() / 255, flow


def pack_rooms(output: Path, *, rooms: int, places: int, seed: int) -> int:
    """Photograph rooms, and return the number of photos. A room takes some seconds.

    Args:
        output: file to write.
        rooms: how many, each with other pictures on the same furniture.
        places: per room, each with three views.
        seed: of the first room.
    """
    arrays: dict[str, NDArray[np.generic]] = {}
    for room in range(rooms):
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
                arrays[f"{name}.cam_from_world"] = np.column_stack(
                    [pose.rotation, pose.translation]
                )
    write_tensors(output, arrays, {"rooms": rooms, "places": places, "seed": seed})
    return len(arrays) // 3


def _moved(rng: np.random.Generator) -> Pose:
    """Return a small motion of a camera, as new_from_old."""
    rotation = np.eye(3)
    for axis, most in zip(np.eye(3), _MAX_TURN_DEG, strict=True):
        rotation = rotation_about(axis, float(np.deg2rad(rng.uniform(-most, most)))) @ rotation
    return Pose(rotation, -rotation @ rng.uniform(-_MAX_SHIFT_M, _MAX_SHIFT_M, 3))


def _encoded(suffix: str, image: NDArray[np.generic], options: list[int]) -> NDArray[np.uint8]:
    _, data = cv2.imencode(suffix, np.ascontiguousarray(image), options)
    return np.asarray(data, np.uint8).ravel()


def read_rooms(path: Path, device: torch.device) -> tuple[Place, ...]:
    """Read what ``pack_rooms`` wrote; the photos go onto the device.

    Raises:
        NotFound: ``training.rooms`` if there is no such file.
        InvalidInput: ``training.rooms`` if it is another kind of file.
    """
    if not path.is_file():
        raise refuse("training.rooms", field=str(path), kind=NotFound)
    try:
        packed = load(path.read_bytes())
        names = sorted(name.removesuffix(".image") for name in packed if name.endswith(".image"))
        places: dict[str, list[View]] = {}
        for name in names:
            places.setdefault(name.rpartition("-")[0], []).append(_view(packed, name, device))
    except (SafetensorError, ValueError, KeyError, cv2.error) as error:
        raise refuse(
            "training.rooms", f"the rooms cannot be read: {error}", field=str(path)
        ) from error
    return tuple(tuple(views) for views in places.values())


def _view(packed: Mapping[str, NDArray[Any]], name: str, device: torch.device) -> View:
    bgr = cv2.imdecode(packed[f"{name}.image"], cv2.IMREAD_COLOR)
    units = cv2.imdecode(packed[f"{name}.inverse_depth"], cv2.IMREAD_UNCHANGED)
    if bgr is None or units is None:
        raise ValueError(f"{name} cannot be decoded")
    matrix = packed[f"{name}.cam_from_world"].reshape(3, 4)
    rgb = np.ascontiguousarray(bgr[..., ::-1].transpose(2, 0, 1))
    return View(
        torch.from_numpy(rgb).to(device),
        units.astype(np.float32) * np.float32(_INVERSE_DEPTH_UNIT),
        Pose(matrix[:, :3], matrix[:, 3]),
    )
