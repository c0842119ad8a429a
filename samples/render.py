"""Photographs of the sample world: true perspective, exact depth, no aliasing.

A camera sees a rectangle with corner C and edges U, V (in camera axes) through the pixel with
the ray d = (x, y, 1) where z d = C + u U + v V. Dividing by the depth z gives
d = [U V C] (u/z, v/z, 1/z), so that u/z, v/z and 1/z are linear in the pixel: one 3 x 3 matrix
per rectangle, exact everywhere, and the nearest rectangle is the one with the largest 1/z.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from samples.scene import Rectangle, Scene
from samples.textures import Image
from visloc.errors import refuse
from visloc.geometry import Camera, Pose

_NEAR_M = 0.01
# Rays per pixel side for photos; 2 x 2 rays on prefiltered pictures leave no visible stairs.
_RAYS = 2
_VIGNETTING = 0.25  # loss of light in the corners
_NOISE_SIGMA = 1.2  # grey levels
_ROW = 4096  # cv2.remap takes maps of fewer than 32768 columns


@dataclass(frozen=True, slots=True, eq=False)
class _Hits:
    """What the rays of one picture meet; arrays are (rows, columns) of the ray grid.

    Attributes:
        rectangle: int16 index into the scene, -1 where there is nothing.
        inverse_depth: 1/z, 0 where there is nothing.
        local_from_pixel: (R, 3, 3) float64; (u/z, v/z, 1/z) of each rectangle at (x, y, 1).
    """

    rectangle: NDArray[np.int16]
    inverse_depth: NDArray[np.floating]
    local_from_pixel: NDArray[np.float64]


def render_depth(scene: Scene, camera: Camera, cam_from_world: Pose) -> NDArray[np.float64]:
    """Return the depth through every pixel's centre.

    Returns:
        (height, width) metres along the optical axis, exact to rounding; 0 where there is
        nothing.
    """
    inverse_depth = _cast(scene, camera, cam_from_world, 1, np.float64).inverse_depth
    depth = np.zeros_like(inverse_depth, dtype=np.float64)
    np.divide(1.0, inverse_depth, out=depth, where=inverse_depth > 0)
    return depth


def render_photo(
    scene: Scene, camera: Camera, cam_from_world: Pose, noise: np.random.Generator | None = None
) -> Image:
    """Take a photo, with slightly darker corners as lenses give them.

    Args:
        scene: what is seen; black where there is nothing.
        noise: adds sensor noise of about one grey level; none without it.

    Returns:
        (height, width, 3) uint8 RGB. A pixel is the mean colour over its square, whose centre
        is (0.5, 0.5) for the top-left one.
    """
    hits = _cast(scene, camera, cam_from_world, _RAYS, np.float32)
    order = np.argsort(hits.rectangle, axis=None, kind="stable").astype(np.int32)
    starts = np.searchsorted(
        hits.rectangle.ravel()[order], np.arange(len(scene.rectangles) + 1, dtype=np.int16)
    )
    columns = hits.rectangle.shape[1]
    colours = np.zeros((hits.rectangle.size, 3), dtype=np.uint8)
    for index, rectangle in enumerate(scene.rectangles):
        rays = order[starts[index] : starts[index + 1]]
        if len(rays):
            local_from_pixel = hits.local_from_pixel[index]
            colours[rays] = _seen_colours(rectangle, local_from_pixel, rays, columns)
    fine = colours.reshape(*hits.rectangle.shape, 3)
    photo = cv2.resize(fine, (camera.width, camera.height), interpolation=cv2.INTER_AREA).astype(
        np.float32
    )
    photo *= _vignetting(camera)[..., None]
    if noise is not None:
        photo += np.float32(_NOISE_SIGMA) * noise.standard_normal(photo.shape, dtype=np.float32)
    return np.asarray(np.clip(photo + 0.5, 0, 255), dtype=np.uint8)


def _cast(
    scene: Scene, camera: Camera, cam_from_world: Pose, rays: int, dtype: type[np.floating]
) -> _Hits:
    """Send rays x rays rays through each pixel and keep the nearest hits."""
    if camera.model != "PINHOLE":
        raise refuse(
            "camera.model",
            "the renderer supports one camera model only",
            field="camera.model",
            expected="PINHOLE",
            got=camera.model,
        )
    rows, columns = camera.height * rays, camera.width * rays
    x = ((np.arange(columns) + 0.5) / rays).astype(dtype)
    y = ((np.arange(rows) + 0.5) / rays).astype(dtype)
    # Neighbouring walls share an edge: without slack, rounding opens cracks between them.
    slack = dtype(1e-9 if dtype is np.float64 else 1e-5)
    nearest = np.full((rows, columns), -1, dtype=np.int16)
    inverse_depth = np.zeros((rows, columns), dtype=dtype)
    matrices = np.zeros((len(scene.rectangles), 3, 3))
    for index, rectangle in enumerate(scene.rectangles):
        window = _window(rectangle, camera, cam_from_world)
        matrix = _local_from_pixel(rectangle, camera, cam_from_world)
        if window is None or matrix is None:
            continue
        matrices[index] = matrix
        left, top, right, bottom = (bound * rays for bound in window)
        inside = (slice(top, bottom), slice(left, right))
        u, v, w = (
            (row[0] * x[None, left:right] + (row[1] * y[top:bottom, None] + row[2]))
            for row in matrix.astype(dtype)
        )
        lowest, highest = -slack * w, (1 + slack) * w
        hit = (w > inverse_depth[inside]) & (u >= lowest) & (v >= lowest)
        hit &= (u <= highest) & (v <= highest)
        inverse_depth[inside][hit] = w[hit]
        nearest[inside][hit] = index
    return _Hits(nearest, inverse_depth, matrices)


def _local_from_pixel(
    rectangle: Rectangle, camera: Camera, cam_from_world: Pose
) -> NDArray[np.float64] | None:
    """Return the matrix from (x, y, 1) to (u/z, v/z, 1/z), None if seen exactly edge-on."""
    fx, fy, cx, cy = camera.params
    rotation = cam_from_world.rotation
    edges = np.column_stack(
        [
            rotation @ rectangle.edge_u,
            rotation @ rectangle.edge_v,
            cam_from_world.apply(rectangle.corner),
        ]
    )
    if abs(np.linalg.det(edges)) < 1e-9:
        return None
    ray_from_pixel = np.array([[1 / fx, 0, -cx / fx], [0, 1 / fy, -cy / fy], [0, 0, 1]])
    return np.asarray(np.linalg.inv(edges) @ ray_from_pixel)


def _window(
    rectangle: Rectangle, camera: Camera, cam_from_world: Pose
) -> tuple[int, int, int, int] | None:
    """Return the pixels (left, top, right, bottom) that may see the rectangle, None if none."""
    corners = cam_from_world.apply(
        np.array([rectangle.at(u, v) for u, v in ((0, 0), (1, 0), (1, 1), (0, 1))])
    )
    visible = []
    for here, there in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if here[2] >= _NEAR_M:
            visible.append(here)
        if (here[2] >= _NEAR_M) != (there[2] >= _NEAR_M):
            share = (_NEAR_M - here[2]) / (there[2] - here[2])
            visible.append(here + share * (there - here))
    if not visible:
        return None
    fx, fy, cx, cy = camera.params
    points = np.array(visible)
    x = fx * points[:, 0] / points[:, 2] + cx
    y = fy * points[:, 1] / points[:, 2] + cy
    left, right = (int(b) for b in np.clip([x.min() - 1, x.max() + 2], 0, camera.width))
    top, bottom = (int(b) for b in np.clip([y.min() - 1, y.max() + 2], 0, camera.height))
    return (left, top, right, bottom) if left < right and top < bottom else None


def _seen_colours(
    rectangle: Rectangle,
    local_from_pixel: NDArray[np.float64],
    rays: NDArray[np.int32],
    columns: int,
) -> Image:
    """Return the colours (N, 3) that rays (N,), counted row by row, bring from a rectangle."""
    x = ((rays % columns + 0.5) / _RAYS).astype(np.float32)
    y = ((rays // columns + 0.5) / _RAYS).astype(np.float32)
    m = local_from_pixel.astype(np.float32)
    z = 1.0 / (m[2, 0] * x + m[2, 1] * y + m[2, 2])
    u = (m[0, 0] * x + m[0, 1] * y + m[0, 2]) * z
    v = (m[1, 0] * x + m[1, 1] * y + m[1, 2]) * z
    level = _level(rectangle, m, u, v, z)
    base = level.astype(np.int8)
    colours = np.empty((len(rays), 3), dtype=np.uint8)
    for step in range(int(base.min()), int(base.max()) + 1):
        chosen = np.flatnonzero(base == step)
        if not len(chosen):
            continue
        u_there, v_there = u[chosen], v[chosen]
        finer = _lookup(rectangle.levels[step], u_there, v_there)
        if step + 1 < len(rectangle.levels):
            coarser = _lookup(rectangle.levels[step + 1], u_there, v_there)
            share = (level[chosen] - step)[:, None]
            colours[chosen] = finer + share * (coarser.astype(np.float32) - finer) + 0.5
        else:
            colours[chosen] = finer
    return colours


def _level(
    rectangle: Rectangle,
    m: NDArray[np.float32],
    u: NDArray[np.float32],
    v: NDArray[np.float32],
    z: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Return the (fractional) picture level (N,) whose texels are as large as a ray's footprint.

    The footprint is an ellipse; its long axis may be two texels long, which the several rays
    of a pixel even out, so that floors seen at a flat angle stay sharp.
    """
    height, width = rectangle.levels[0].shape[:2]
    across, along = np.float32(width / _RAYS) * z, np.float32(height / _RAYS) * z
    ux, uy = across * (m[0, 0] - u * m[2, 0]), across * (m[0, 1] - u * m[2, 1])
    vx, vy = along * (m[1, 0] - v * m[2, 0]), along * (m[1, 1] - v * m[2, 1])
    total = ux * ux + uy * uy + vx * vx + vy * vy
    area = (ux * vy - uy * vx) ** 2
    longest = 0.5 * (total + np.sqrt(np.maximum(total * total - 4 * area, 0)))
    size = np.maximum(area / np.maximum(longest, 1e-12), longest / 4)
    level = 0.5 * np.log2(np.maximum(size, 1.0))
    return np.asarray(np.minimum(level, len(rectangle.levels) - 1), dtype=np.float32)


def _lookup(picture: Image, u: NDArray[np.float32], v: NDArray[np.float32]) -> Image:
    """Return the colours (N, 3) of a picture at u, v (N,), bilinear between texel centres."""
    height, width = picture.shape[:2]
    padded = -(-len(u) // _ROW) * _ROW
    map_x, map_y = np.zeros(padded, np.float32), np.zeros(padded, np.float32)
    map_x[: len(u)] = u * width - 0.5
    map_y[: len(v)] = v * height - 0.5
    found = cv2.remap(
        picture,
        map_x.reshape(-1, _ROW),
        map_y.reshape(-1, _ROW),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.asarray(found, dtype=np.uint8).reshape(-1, 3)[: len(u)]


def _vignetting(camera: Camera) -> NDArray[np.float32]:
    x = (np.arange(camera.width, dtype=np.float32) + 0.5) / camera.width - 0.5
    y = (np.arange(camera.height, dtype=np.float32) + 0.5) / camera.height - 0.5
    return np.asarray(1 - 2 * _VIGNETTING * (x[None, :] ** 2 + y[:, None] ** 2), dtype=np.float32)
