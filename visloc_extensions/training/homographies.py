"""Two looks at one photo, as if it hung on a wall: exact flow without depth.

Each look is a pinhole camera before the plane of the photo. A crop pixel and a photo pixel are
joined by the homography ``photo_from_crop`` (3, 3), both with pixel centres at halves. Everything
is made for many pairs at a time.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Matrices = NDArray[np.float64]

# Photo pixels per crop pixel of the first look: from enlarged to well reduced.
_SCALES = (0.6, 2.3)
# At full strength, for the second look beside the first:
_MAX_TILT_DEG = 50.0
_MAX_TURN_DEG = 30.0  # in the image plane: what hands do to phones
_MAX_SCALE_CHANGE = 1.5
_MAX_SHIFT = 0.2  # of the crop's side
_FIRST_TILT_DEG = 15.0
# Focal length over the crop's side: a crop is a part of a photo.
_FOCAL = (1.2, 3.0)
_GENTLEST = 0.25  # strength of the first pairs when they start mild


def strength_at(step: int, mild_steps: int) -> float:
    """Return how hard pairs are, up to 1: growing during the mild steps."""
    return 1.0 if step >= mild_steps else _GENTLEST + (1 - _GENTLEST) * step / mild_steps


def random_looks(
    rng: np.random.Generator, sizes: NDArray[np.int64], crop_px: int, strength: float
) -> tuple[Matrices, Matrices]:
    """Return photo_from_crop (n, 3, 3) of two looks at about the same part of each photo.

    Args:
        sizes: (n, 2), height and width of the photos.
        strength: 0 to 1, how far the second look is from the first.
    """
    pairs, shorter = len(sizes), sizes.min(axis=1)
    lowest, highest = np.log(_SCALES)
    # The first crop has to fit into the photo, tilted a little.
    most = np.minimum(highest, np.log(0.8 * shorter / crop_px))
    scale = np.exp(rng.uniform(np.minimum(lowest, most), most))
    margin = np.minimum(0.6 * scale * crop_px, 0.5 * shorter)[:, None]
    target = rng.uniform(margin, sizes[:, ::-1] - margin)
    first = looks_at(rng, target, scale, crop_px, tilt_deg=_FIRST_TILT_DEG * strength, turn_deg=0.0)
    second = looks_at(
        rng,
        target + rng.uniform(-1, 1, (pairs, 2)) * _MAX_SHIFT * strength * scale[:, None] * crop_px,
        scale * np.exp(strength * np.log(_MAX_SCALE_CHANGE) * rng.uniform(-1, 1, pairs)),
        crop_px,
        tilt_deg=_MAX_TILT_DEG * strength,
        turn_deg=_MAX_TURN_DEG * strength,
    )
    swapped = (rng.random(pairs) < 0.5)[:, None, None]
    return np.where(swapped, second, first), np.where(swapped, first, second)


def looks_at(
    rng: np.random.Generator,
    target: NDArray[np.float64],
    scale: NDArray[np.float64],
    crop_px: int,
    *,
    tilt_deg: float,
    turn_deg: float,
) -> Matrices:
    """Return photo_from_crop (n, 3, 3) of cameras that look at targets (n, 2) of photos.

    Args:
        target: photo pixels in the middle of the crops.
        scale: (n,) photo pixels per crop pixel there, the mean of all directions.
        tilt_deg: largest angle between the optical axis and the photo's normal.
        turn_deg: largest turn about the optical axis.
    """
    looks = len(target)
    tilt = np.deg2rad(rng.uniform(0, tilt_deg, looks))
    turn = np.deg2rad(rng.uniform(-turn_deg, turn_deg, looks))
    about = rng.uniform(0, 2 * np.pi, looks)
    focal = rng.uniform(*_FOCAL, looks) * crop_px
    # Foreshortening takes cos(tilt) off one direction: closer by its root keeps the area.
    distance = focal * scale * np.sqrt(np.cos(tilt))
    axis = np.stack([np.cos(about), np.sin(about), np.zeros(looks)], axis=1)
    upright = np.broadcast_to([0.0, 0.0, 1.0], (looks, 3))
    cam_from_plane = rotations_about(upright, turn) @ rotations_about(axis, tilt)
    cam_from_plane[:, :, 2] = 0
    cam_from_plane[:, 2, 2] = distance
    crop_from_cam = np.zeros((looks, 3, 3))
    crop_from_cam[:, 0, 0] = crop_from_cam[:, 1, 1] = focal
    crop_from_cam[:, :2, 2] = crop_px / 2
    crop_from_cam[:, 2, 2] = 1
    photo_from_crop = np.linalg.inv(
        crop_from_cam @ cam_from_plane @ scaled_and_moved(np.ones((looks, 2)), -target)
    )
    return np.asarray(photo_from_crop / photo_from_crop[:, 2:, 2:])


def rotations_about(axes: NDArray[np.float64], angles: NDArray[np.float64]) -> Matrices:
    """Return the rotations (n, 3, 3) by angles (n,) about unit axes (n, 3) (Rodrigues)."""
    x, y, z = axes.T
    none = np.zeros_like(x)
    cross = np.stack([none, -z, y, z, none, -x, -y, x, none], axis=1).reshape(-1, 3, 3)
    sine, cosine = np.sin(angles)[:, None, None], np.cos(angles)[:, None, None]
    return np.asarray(np.eye(3) + sine * cross + (1 - cosine) * cross @ cross)


def scaled_and_moved(scale: NDArray[np.float64], shift: NDArray[np.float64]) -> Matrices:
    """Return matrices (n, 3, 3) that multiply x and y by scales (n, 2), then add shifts (n, 2)."""
    matrices = np.zeros((len(scale), 3, 3))
    matrices[:, 0, 0], matrices[:, 1, 1] = scale.T
    matrices[:, :2, 2] = shift
    matrices[:, 2, 2] = 1
    return matrices


def moved(homographies: Matrices, points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return where homographies (..., 3, 3) take points (..., N, 2)."""
    ones = np.ones_like(points[..., :1])
    lifted = np.concatenate([points, ones], axis=-1) @ np.swapaxes(homographies, -1, -2)
    return np.asarray(lifted[..., :2] / lifted[..., 2:])


def scales(photo_from_crop: Matrices, crop_px: int) -> NDArray[np.float64]:
    """Return photo pixels per crop pixel (n,): the root of the area of the middle pixel."""
    middle = np.array([crop_px / 2, crop_px / 2, 1.0])
    # The determinant of a homography's derivative.
    area = np.linalg.det(photo_from_crop) / (photo_from_crop[:, 2] @ middle) ** 3
    return np.asarray(np.sqrt(np.abs(area)))


def pixel_centres(crop_px: int, device: torch.device) -> Tensor:
    """Return (H, W, 2) float64, x and y."""
    places = torch.arange(crop_px, dtype=torch.float64, device=device) + 0.5
    y, x = torch.meshgrid(places, places, indexing="ij")
    return torch.stack([x, y], dim=-1)


def applied(homographies: Tensor, points: Tensor) -> Tensor:
    """Return where homographies (n, 3, 3) take points (n, H, W, 2) or (H, W, 2)."""
    h = homographies[:, None, None]
    x, y = points[..., 0], points[..., 1]
    u, v, w = (h[..., row, 0] * x + h[..., row, 1] * y + h[..., row, 2] for row in range(3))
    return torch.stack([u / w, v / w], dim=-1)
