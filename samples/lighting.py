"""Light and soft shadows, baked into the pictures: a spot looks the same from everywhere.

Every surface is matt (Lambert): a spot is lit by an ambient term and by four lamps with inverse
square fall-off; what stands between the spot and parts of a lamp casts a soft shadow.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from samples.textures import Image, stretch

Vector = NDArray[np.float64]

_SPOT_M = 0.08  # light is computed on a grid this fine and interpolated
_AMBIENT = 0.64
_LAMP_POWER = 0.9
_LAMPS = ((-1.9, -0.7, 2.2), (-1.1, 1.2, 2.2), (1.1, -1.0, 2.2), (1.7, 0.7, 2.2))
# Parts of a lamp, in metres from its middle: what hides only some of them casts half a shadow.
_LAMP_PARTS = ((0.0, 0.0), (0.14, 0.04), (-0.04, 0.14), (-0.14, -0.04), (0.04, -0.14))
_CREVICE_M = 0.22  # less ambient light reaches the room's inner edges, within about this


def light(
    images: Sequence[Image],
    rectangles: Sequence[tuple[Vector, Vector, Vector]],
    room_size_m: tuple[float, float, float],
) -> list[Image]:
    """Return the pictures as lit.

    Args:
        images: (H, W, 3) uint8 each.
        rectangles: (corner, edge_u, edge_v) of each, (3,) metres; the first six are the shell of
            the room, which cannot stand between anything.
    """
    grids = [_spots(*rectangle) for rectangle in rectangles]
    normals = [
        np.broadcast_to(_normal(u, v), grid.shape)
        for grid, (_, u, v) in zip(grids, rectangles, strict=True)
    ]
    brightness = _brightness(
        np.concatenate([grid.reshape(-1, 3) for grid in grids]).astype(np.float32),
        np.concatenate([normal.reshape(-1, 3) for normal in normals]).astype(np.float32),
        rectangles[6:],
        room_size_m,
    )
    lit, start = [], 0
    for image, grid in zip(images, grids, strict=True):
        rows, columns = grid.shape[:2]
        coarse = brightness[start : start + rows * columns].reshape(rows, columns)
        start += rows * columns
        gain = stretch(coarse, image.shape[0], image.shape[1])
        lit.append(_multiplied(image, gain))
    return lit


def _brightness(
    spots: NDArray[np.float32],
    normals: NDArray[np.float32],
    blockers: Sequence[tuple[Vector, Vector, Vector]],
    room_size_m: tuple[float, float, float],
) -> NDArray[np.float32]:
    """Return the factor (N,) by which each spot's colour is multiplied."""
    brightness = np.float32(_AMBIENT) * _openness(spots, normals, room_size_m)
    for lamp in _LAMPS:
        for dx, dy in _LAMP_PARTS:
            ray = np.array([lamp[0] + dx, lamp[1] + dy, lamp[2]], dtype=np.float32) - spots
            distance = np.sqrt((ray * ray).sum(axis=1))
            cosine = np.abs((ray * normals).sum(axis=1)) / distance
            share = np.float32(_LAMP_POWER / len(_LAMP_PARTS)) * cosine
            # Nearer than half a metre it gets no brighter: a photo could not hold it.
            share /= np.maximum(distance, 0.5) ** 2
            share[_blocked(spots, ray, blockers)] = 0.0
            brightness += share
    # A soft shoulder, 1 at 1 and 1.25 at most, keeps texture in the brightest spots.
    bounded = np.minimum(brightness, 2.0)
    return np.asarray(1.25 * bounded / (1.0 + 0.25 * bounded**2), dtype=np.float32)


def _spots(corner: Vector, edge_u: Vector, edge_v: Vector) -> Vector:
    """Return the middles (rows, columns, 3) of the cells of a rectangle's light grid."""
    columns, rows = (max(2, round(float(np.linalg.norm(e)) / _SPOT_M)) for e in (edge_u, edge_v))
    u = (np.arange(columns) + 0.5)[None, :, None] / columns
    v = (np.arange(rows) + 0.5)[:, None, None] / rows
    return np.asarray(corner + u * edge_u + v * edge_v)


def _normal(edge_u: Vector, edge_v: Vector) -> Vector:
    normal = np.cross(edge_u, edge_v)
    return np.asarray(normal / np.linalg.norm(normal))


def _openness(
    spots: NDArray[np.float32],
    normals: NDArray[np.float32],
    room_size_m: tuple[float, float, float],
) -> NDArray[np.float32]:
    """Return 1 (N,) in the open, less near walls, floor and ceiling that the spot is not on."""
    low = np.array([-room_size_m[0] / 2, -room_size_m[1] / 2, 0.0], dtype=np.float32)
    high = np.array([room_size_m[0] / 2, room_size_m[1] / 2, room_size_m[2]], dtype=np.float32)
    open_to = np.ones(len(spots), dtype=np.float32)
    for axis in range(3):
        gap = np.minimum(spots[:, axis] - low[axis], high[axis] - spots[:, axis])
        closing = 0.5 * np.exp(-gap / _CREVICE_M) * (1.0 - np.abs(normals[:, axis]))
        open_to *= 1.0 - closing
    return open_to


def _blocked(
    spots: NDArray[np.float32],
    rays: NDArray[np.float32],
    blockers: Sequence[tuple[Vector, Vector, Vector]],
) -> NDArray[np.bool_]:
    """Tell (N,) which segments from spots to spots + rays meet a rectangle on the way."""
    blocked = np.zeros(len(spots), dtype=np.bool_)
    for corner, edge_u, edge_v in blockers:
        # Coordinates in which the rectangle is 0 <= u, v <= 1 and its plane is w = 0.
        local_from_world = np.linalg.inv(np.column_stack([edge_u, edge_v, _normal(edge_u, edge_v)]))
        matrix = local_from_world.T.astype(np.float32)
        start = (spots - corner.astype(np.float32)) @ matrix
        step = rays @ matrix
        with np.errstate(divide="ignore", invalid="ignore"):
            share = -start[:, 2] / step[:, 2]
            u = start[:, 0] + share * step[:, 0]
            v = start[:, 1] + share * step[:, 1]
        on_the_way = (share > 1e-3) & (share < 1.0)
        blocked |= on_the_way & (u > 0) & (u < 1) & (v > 0) & (v < 1)
    return blocked


def _multiplied(image: Image, gain: NDArray[np.float32]) -> Image:
    planes = [cv2.multiply(plane, gain, dtype=cv2.CV_8U) for plane in cv2.split(image)]
    return np.asarray(cv2.merge(planes), dtype=np.uint8)
