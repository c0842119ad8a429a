"""Two looks at one photo, as if it hung on a wall: exact flow without depth.

Each look is a pinhole camera before the plane of the photo. A crop pixel and a photo pixel are
joined by the homography ``photo_from_crop`` (3, 3), both with pixel centres at halves.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

Matrix = NDArray[np.float64]

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
    rng: np.random.Generator, photo_size: tuple[int, int], crop_px: int, strength: float
) -> tuple[Matrix, Matrix]:
    """Return photo_from_crop of two looks at about the same part of a photo.

    Args:
        rng: random numbers.
        photo_size: height and width.
        crop_px: side of the crops.
        strength: 0 to 1, how far the second look is from the first.
    """
    height, width = photo_size
    lowest, highest = np.log(_SCALES)
    # The first crop has to fit into the photo, tilted a little.
    highest = min(highest, np.log(0.8 * min(height, width) / crop_px))
    scale = float(np.exp(rng.uniform(min(lowest, highest), highest)))
    margin = min(0.6 * scale * crop_px, 0.5 * min(height, width))
    target = np.array([rng.uniform(margin, width - margin), rng.uniform(margin, height - margin)])
    first = _look(rng, target, scale, crop_px, tilt_deg=_FIRST_TILT_DEG * strength, turn_deg=0.0)
    change = np.exp(strength * np.log(_MAX_SCALE_CHANGE) * rng.uniform(-1, 1))
    second = _look(
        rng,
        target + rng.uniform(-1, 1, 2) * _MAX_SHIFT * strength * scale * crop_px,
        scale * float(change),
        crop_px,
        tilt_deg=_MAX_TILT_DEG * strength,
        turn_deg=_MAX_TURN_DEG * strength,
    )
    return (first, second) if rng.random() < 0.5 else (second, first)


def _look(
    rng: np.random.Generator,
    target: NDArray[np.float64],
    scale: float,
    crop_px: int,
    *,
    tilt_deg: float,
    turn_deg: float,
) -> Matrix:
    """Return photo_from_crop of a camera that looks at a target (2,) of the photo.

    Args:
        rng: random numbers.
        target: photo pixel in the middle of the crop.
        scale: photo pixels per crop pixel there, the mean of all directions.
        crop_px: side of the crop.
        tilt_deg: largest angle between the optical axis and the photo's normal.
        turn_deg: largest turn about the optical axis.
    """
    tilt, turn = np.deg2rad([rng.uniform(0, tilt_deg), rng.uniform(-turn_deg, turn_deg)])
    about = rng.uniform(0, 2 * np.pi)
    focal = rng.uniform(*_FOCAL) * crop_px
    # Foreshortening takes cos(tilt) off one direction: closer by its root keeps the area.
    distance = focal * scale * np.sqrt(np.cos(tilt))
    axis = np.array([np.cos(about), np.sin(about), 0.0])
    rotation = rotation_about(np.array([0.0, 0.0, 1.0]), turn) @ rotation_about(axis, tilt)
    cam_from_plane = np.column_stack([rotation[:, 0], rotation[:, 1], [0.0, 0.0, distance]])
    middle = crop_px / 2
    crop_from_cam = np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1]])
    plane_from_photo = np.array([[1, 0, -target[0]], [0, 1, -target[1]], [0, 0, 1]])
    photo_from_crop = np.linalg.inv(crop_from_cam @ cam_from_plane @ plane_from_photo)
    return np.asarray(photo_from_crop / photo_from_crop[2, 2])


def rotation_about(axis: NDArray[np.float64], angle: float) -> Matrix:
    """Return the rotation by an angle about a unit axis (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)


def flow_between(
    photo_from_first: Matrix, photo_from_second: Matrix, crop_px: int, device: torch.device
) -> Tensor:
    """Return the flow (H, W, 2) float32 from the first crop to the second, NaN outside of it."""
    flow = _applied(np.linalg.inv(photo_from_second) @ photo_from_first, crop_px, device)
    inside = ((flow >= 0) & (flow < crop_px)).all(dim=-1, keepdim=True)
    return torch.where(inside, flow, torch.nan).float()


def _applied(matrix: Matrix, crop_px: int, device: torch.device) -> Tensor:
    """Return where (H, W, 2) float64 a homography takes the centres of a crop's pixels."""
    places = torch.arange(crop_px, dtype=torch.float64, device=device) + 0.5
    y, x = torch.meshgrid(places, places, indexing="ij")
    u, v, w = (a * x + b * y + c for a, b, c in matrix.tolist())
    return torch.stack([u / w, v / w], dim=-1)


def look(levels: tuple[Tensor, ...], photo_from_crop: Matrix, crop_px: int) -> Tensor:
    """Return what a camera sees of a photo, (3, H, W) float32 in 0 to 1; mirrored beyond it."""
    level = min(max(round(np.log2(_scale(photo_from_crop, crop_px))), 0), len(levels) - 1)
    picture = levels[level]
    height, width = picture.shape[1:]
    shrunk = np.array([width / levels[0].shape[2], height / levels[0].shape[1]])
    # Only the part that is seen is turned into floats; a homography keeps lines straight, so that
    # the corners say which part it is.
    corners = shrunk * moved(photo_from_crop, crop_px * np.array([[0, 0], [1, 0], [0, 1], [1, 1]]))
    low, high = np.floor(corners.min(axis=0)) - 2, np.ceil(corners.max(axis=0)) + 2
    left, right = _span(int(low[0]), int(high[0]), width)
    top, bottom = _span(int(low[1]), int(high[1]), height)
    part = picture[None, :, top:bottom, left:right].float() / 255
    # From photo pixels to -1 and 1 at the outer edges of the part, as grid_sample counts.
    size = np.array([right - left, bottom - top])
    scale, shift = 2 * shrunk / size, -2 * np.array([left, top]) / size - 1
    grid_from_photo = np.array([[scale[0], 0, shift[0]], [0, scale[1], shift[1]], [0, 0, 1]])
    grid = _applied(grid_from_photo @ photo_from_crop, crop_px, part.device)
    seen = F.grid_sample(
        part, grid[None].float(), mode="bilinear", padding_mode="reflection", align_corners=False
    )
    return seen[0]


def moved(homography: Matrix, points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return where a homography takes points (N, 2)."""
    lifted = np.column_stack([points, np.ones(len(points))]) @ homography.T
    return np.asarray(lifted[:, :2] / lifted[:, 2:])


def _scale(photo_from_crop: Matrix, crop_px: int) -> float:
    """Return photo pixels per crop pixel: the root of the area that the middle pixel covers."""
    middle = crop_px / 2
    origin, across, down = moved(photo_from_crop, middle + np.array([[0, 0], [1, 0], [0, 1]]))
    (a, b), (c, d) = across - origin, down - origin
    return float(np.sqrt(abs(a * d - b * c)))


def _span(low: int, high: int, size: int) -> tuple[int, int]:
    """Return the part of 0 to size that low to high covers, never empty."""
    start = min(max(low, 0), size - 1)
    return start, max(min(high, size), start + 1)
