"""Points that photos with known poses see, from one photo's keypoints and their matches in others.

Hartley and Zisserman, Multiple View Geometry, chapter 12. Matches of descriptors are wrong more
often than keypoints are off, so each pair of rays proposes a point, the other rays vote, and the
point is then refined on the rays that agree.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_NUM_ROUNDS = 2
_LEAST = 1e-12  # a determinant of rays that are parallel, a distance of a point at a camera
# Added to the diagonal of systems that have no answer, so that those beside them are solved.
_UNSOLVABLE = 1e-9


def triangulated(
    rays: NDArray[np.float64],
    centers: NDArray[np.float64],
    focal_lengths: NDArray[np.float64],
    *,
    max_error_px: float,
    min_angle: float,
) -> NDArray[np.float64]:
    """Triangulate the keypoints of the first photo.

    A point is kept if the first photo and at least one other see it within ``max_error_px``, in
    front of them, and if two of these rays, one of the first photo, meet at ``min_angle`` or more.

    Args:
        rays: (k, v, 3) of length 1 along the world's axes, from photo to keypoint; NaN where the
            keypoint has no match in that photo.
        centers: (v, 3) of the photos in the world.
        focal_lengths: (v,) pixels.
        max_error_px: largest reprojection error, measured as an angle times the focal length.
        min_angle: rad.

    Returns:
        (k, 3) points in the world; NaN where there is none.
    """
    seen: NDArray[np.bool_] = np.asarray(np.isfinite(rays).all(axis=2))
    rays = np.where(seen[:, :, None], rays, 0.0)
    points = np.full((len(rays), 3), np.nan)
    counts = np.zeros(len(rays), dtype=np.int64)
    least_errors = np.full(len(rays), np.inf)
    cosines = np.einsum("kvi,ki->kv", rays, rays[:, 0])
    wide: NDArray[np.bool_] = np.asarray(cosines <= np.cos(min_angle))
    for other in range(1, len(centers)):
        rows = np.flatnonzero(seen[:, 0] & seen[:, other] & wide[:, other])
        proposed = _where_two_meet(rays[rows, 0], rays[rows, other], centers[0], centers[other])
        errors = _errors_px(proposed, rays[rows], seen[rows], centers, focal_lengths)
        agree = errors <= max_error_px
        count = np.where(agree[:, 0] & agree[:, other], agree.sum(axis=1), 0)
        error = np.where(agree, errors, 0.0).sum(axis=1)
        better = count > counts[rows]
        better |= (count == counts[rows]) & (count > 0) & (error < least_errors[rows])
        chosen = rows[better]
        points[chosen], counts[chosen] = proposed[better], count[better]
        least_errors[chosen] = error[better]
    found = np.flatnonzero(counts)
    rays, seen, wide = rays[found], seen[found], wide[found]
    refined = points[found]
    for _ in range(_NUM_ROUNDS):
        agree = _errors_px(refined, rays, seen, centers, focal_lengths) <= max_error_px
        refined = _nearest_to(rays, agree, refined, centers, focal_lengths)
    agree = _errors_px(refined, rays, seen, centers, focal_lengths) <= max_error_px
    points[found] = np.where((agree[:, 0] & (agree & wide).any(axis=1))[:, None], refined, np.nan)
    return points


def _where_two_meet(
    a: NDArray[np.float64],
    b: NDArray[np.float64],
    center_a: NDArray[np.float64],
    center_b: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the points (n, 3) in the middle between rays where they are nearest to each other."""
    apart = center_b - center_a
    cosine = np.einsum("ni,ni->n", a, b)
    along_a, along_b = a @ apart, b @ apart
    determinant = np.maximum(1.0 - cosine**2, _LEAST)
    s = (along_a - cosine * along_b) / determinant
    r = (cosine * along_a - along_b) / determinant
    return np.asarray((center_a + s[:, None] * a + center_b + r[:, None] * b) / 2)


def _errors_px(
    points: NDArray[np.float64],
    rays: NDArray[np.float64],
    seen: NDArray[np.bool_],
    centers: NDArray[np.float64],
    focal_lengths: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return how far each ray (n, v) passes by its point; infinite behind, and where none is."""
    away = points[:, None] - centers
    along = np.einsum("nvi,nvi->nv", away, rays)
    aside = np.linalg.norm(away - along[:, :, None] * rays, axis=2)
    in_front = seen & (along > _LEAST)
    return np.where(in_front, aside / np.where(in_front, along, 1.0) * focal_lengths, np.inf)


def _nearest_to(
    rays: NDArray[np.float64],
    agree: NDArray[np.bool_],
    points: NDArray[np.float64],
    centers: NDArray[np.float64],
    focal_lengths: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the points nearest to rays that agree, which count by pixels, not by metres."""
    away2 = np.maximum(((points[:, None] - centers) ** 2).sum(axis=2), _LEAST)
    weights = np.where(agree, focal_lengths**2 / away2, 0.0)
    weights /= np.maximum(weights.max(axis=1, keepdims=True), _LEAST)
    across = weights[:, :, None, None] * (np.eye(3) - rays[..., :, None] * rays[..., None, :])
    matrix = across.sum(axis=1)
    wanted = np.einsum("nvij,vj->ni", across, centers)
    matrix += np.where(agree.sum(axis=1) >= 2, 0.0, _UNSOLVABLE)[:, None, None] * np.eye(3)
    return np.asarray(np.linalg.solve(matrix, wanted[:, :, None])[:, :, 0])
