"""Photos whose viewing frusta overlap, seen from similar sides.

The reference published no definition of its frustum overlap; this is ours. A camera may see any
point that projects into its image at a depth (along its axis) from ``near`` to ``far``. The depth
of the scene is unknown, so all orders of magnitude count the same: depths are weighted by their
logarithm. A point that A may see counts as shared with B if

1. it projects into B's image,
2. its depth in B is from ``near`` to ``far``,
3. the rays to it from both centres differ by less than 60 degrees, because local features do not
   match beyond. Two cameras that face each other across a place thus share nothing.

For a pixel of A with the ray r = (x, y, 1), the point at depth z is z Q + t in B's frame, with
Q = R r and ``B_from_A = (R, t)``. Each side of B's image, both depths of B and the angle ask for
``a z + b >= 0`` with some a and b (the angle: ``z |r| + t.q >= |t - (t.q) q| / tan 60`` with
q = Q / |r|), so that the shared depths of a pixel are one interval [low, high] in closed form. With
the mean over a grid of pixels,

    overlap(A in B) = mean of max(0, ln(high / low)) / ln(far / near),
    score(A, B)     = min(overlap(A in B), overlap(B in A)),

from 0 to 1. Pairs that score less than 0.1 are rejected.

Approximations:
    - Pixels are turned into rays with the full camera model; B's image, to project into, is the
      rectangle at depth 1 that bounds the rays of its grid and of the middles of its edges.
    - Walls are unknown: cameras in adjacent rooms may pair.
    - Each photo is scored only with its nearest ``max(300, 15 top_k)`` others, and with photos
      that have it among theirs; near in position over sqrt(near far) and viewing direction. Photos
      with fewer others in reach are ranked exactly. Of the true 20 best of a photo, this finds more
      than 99 % among 10 000 random photos in a room, and 96 % in a square of 60 x 60 m; the
      substitutes score nearly the same (99.8 % of the sum).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mapping.pairing.posed import PosedPhotos, nearest, posed_photos
from mapping.pairing.ranking import best_pairs
from mapping.pairing.scene import Pairs, Scene
from mapping.pairing.settings import PairSettings
from visloc.errors import refuse
from visloc.geometry import Camera
from visloc.pose.reprojection import normalized_rays

MIN_OVERLAP = 0.1
_MAX_RAY_ANGLE = math.radians(60.0)
_GRID = (8, 6)  # pixels across and down
_MIN_NEIGHBOURS = 300
_NEIGHBOURS_PER_PAIR = 15
_BLOCK_SIZE = 1024  # pairs scored at a time: their arrays then stay in the processor's cache
_MAX_SLOPE = 1e3  # of a ray; 89.94 degrees off the axis


@dataclass(frozen=True, slots=True, eq=False)
class _Views:
    """The views of photos; arrays along the photos of ``posed``.

    Attributes:
        camera_of: (p,) index into the arrays below.
        rays: (c, g, 3) at depth 1, of a grid of pixels.
        bounds: (c, 2, 2) least and greatest (x, y) at depth 1.
    """

    posed: PosedPhotos
    camera_of: NDArray[np.int64]
    rays: NDArray[np.float64]
    bounds: NDArray[np.float64]


def pair_by_frustum(scene: Scene, settings: PairSettings) -> Pairs:
    """Pair every photo with the ``top_k`` that overlap most with it.

    Photos without a pose or without intrinsics get no pair. Photos from the very same place pair
    all the same; their matches are lost, since without a baseline given poses confirm none
    (``visloc.matching.verification.epipolar_errors``).
    """
    posed = posed_photos(scene, "frustum", with_camera=True)
    views = _views(posed, scene)
    pairs = _candidates(views, settings)
    scores = np.empty(len(pairs))
    for start in range(0, len(pairs), _BLOCK_SIZE):
        first, second = pairs[start : start + _BLOCK_SIZE].T
        scores[start : start + _BLOCK_SIZE] = np.minimum(
            _overlap(views, first, second, settings), _overlap(views, second, first, settings)
        )
    kept = scores >= MIN_OVERLAP
    found = best_pairs(pairs[kept], scores[kept], settings.top_k)
    return Pairs(posed.rows[found.rows], found.scores)


def _views(posed: PosedPhotos, scene: Scene) -> _Views:
    index: dict[Camera, int] = {}
    camera_of = np.empty(len(posed.rows), dtype=np.int64)
    rays, bounds = [], []
    for i, row in enumerate(posed.rows):
        camera = scene.cameras[row]
        assert camera is not None  # posed_photos saw to it
        if camera not in index:
            index[camera] = len(index)
            camera_rays, camera_bounds = _image_at_depth_one(camera, scene.names[row])
            rays.append(camera_rays)
            bounds.append(camera_bounds)
        camera_of[i] = index[camera]
    return _Views(posed, camera_of, np.stack(rays), np.stack(bounds))


def _image_at_depth_one(
    camera: Camera, name: str
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the rays (g, 3) of a grid of pixels, and the least and greatest (x, y), (2, 2).

    Where a pixel has no ray, because its distortion cannot be undone or because it looks
    sideways, another takes its place.
    """
    across, down = _GRID
    u, v = np.meshgrid((np.arange(across) + 0.5) / across, (np.arange(down) + 0.5) / down)
    grid = np.column_stack([u.ravel(), v.ravel()])
    edges = np.array([[0.0, 0.5], [1.0, 0.5], [0.5, 0.0], [0.5, 1.0]])
    pixels = np.vstack([grid, edges]) * [camera.width, camera.height]
    rays = normalized_rays(camera, pixels)
    usable = np.abs(rays).max(axis=1) <= _MAX_SLOPE  # false for NaN
    if not usable[: len(grid)].any():
        raise refuse("pairs.camera", field=name, got=f"{camera.model} {camera.params}")
    seen = rays[usable, :2]
    return (
        np.resize(rays[: len(grid)][usable[: len(grid)]], (len(grid), 3)),
        np.stack([seen.min(axis=0), seen.max(axis=0)]),
    )


def _candidates(views: _Views, settings: PairSettings) -> NDArray[np.int64]:
    """Choose the pairs (m, 2) to score, each once and sorted."""
    posed = views.posed
    num_photos = len(posed.rows)
    # Two rays that meet at less than 60 degrees start no farther apart than the longer is long.
    reach = settings.far * math.hypot(1.0, *np.abs(views.bounds).max(axis=(0, 1)))
    middle = views.rays.mean(axis=1)[views.camera_of]
    looks = np.einsum("pij,pi->pj", posed.rotations, middle)
    looks /= np.linalg.norm(looks, axis=1, keepdims=True)
    centers = posed.centers - posed.centers.mean(axis=0)
    # At the middle depth z of the logarithmic scale, a turn by some angle moves the view about as
    # much as a shift by that angle times z. Measured: see the module's docstring.
    scale = math.sqrt(settings.near * settings.far)
    points = np.hstack([centers / scale, looks])
    tree = cKDTree(points)
    num_neighbours = min(
        max(_MIN_NEIGHBOURS, _NEIGHBOURS_PER_PAIR * settings.top_k) + 1, num_photos
    )
    within = 1.000001 * math.hypot(reach / scale, 2.0)  # directions are at most 2 apart
    codes = []
    for start in range(0, num_photos, _BLOCK_SIZE):
        photos = np.arange(start, min(start + _BLOCK_SIZE, num_photos))
        bound, others = nearest(tree, points[photos], num_neighbours, within=within)
        row, column = np.nonzero(np.isfinite(bound))
        first, second = photos[row], others[row, column]
        in_reach = np.linalg.norm(centers[first] - centers[second], axis=1) <= reach
        kept = in_reach & (first != second)
        first, second = first[kept], second[kept]
        codes.append(np.minimum(first, second) * num_photos + np.maximum(first, second))
    found = np.unique(np.concatenate(codes))
    return np.column_stack([found // num_photos, found % num_photos])


def _overlap(
    views: _Views,
    a: NDArray[np.int64],
    b: NDArray[np.int64],
    settings: PairSettings,
) -> NDArray[np.float64]:
    """Return the overlap (m,) of photos a (m,) in photos b (m,)."""
    posed = views.posed
    rays = views.rays[views.camera_of[a]]
    b_from_a = posed.rotations[b] @ posed.rotations[a].transpose(0, 2, 1)
    x, y, z = np.moveaxis(rays @ b_from_a.transpose(0, 2, 1), 2, 0)  # Q of the formula, (m, g)
    t = np.einsum("mij,mj->mi", posed.rotations[b], posed.centers[a] - posed.centers[b])
    tx, ty, tz = t.T[:, :, None]
    (x_min, y_min), (x_max, y_max) = np.moveaxis(views.bounds[views.camera_of[b]], 0, 2)[..., None]
    length = np.linalg.norm(rays, axis=2)
    along = (tx * x + ty * y + tz * z) / length
    aside = np.sqrt(np.maximum(tx**2 + ty**2 + tz**2 - along**2, 0.0))
    low = np.full(x.shape, settings.near, np.float64)  # whole numbers are given too
    high = np.full(x.shape, settings.far, np.float64)
    for slope, offset in (
        (x - x_min * z, tx - x_min * tz),
        (x_max * z - x, x_max * tz - tx),
        (y - y_min * z, ty - y_min * tz),
        (y_max * z - y, y_max * tz - ty),
        (z, tz - settings.near),
        (-z, settings.far - tz),
        (length, along - aside / math.tan(_MAX_RAY_ANGLE)),
    ):
        # slope * depth + offset >= 0: from this depth on, or up to it. Where both are zero the
        # ray lies within the plane; fmax passes over the NaN.
        rising = slope >= 0
        with np.errstate(divide="ignore", invalid="ignore"):
            limit = -offset / np.abs(slope)
        np.fmax(low, np.where(rising, limit, -np.inf), out=low)
        np.fmin(high, np.where(rising, np.inf, -limit), out=high)
    shared = np.log(np.maximum(high / low, 1.0))
    return np.asarray(shared.mean(axis=1) / math.log(settings.far / settings.near))
