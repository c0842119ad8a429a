"""Verifying matches of two photos whose poses are known."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from visloc.geometry import Pose


def epipolar_errors(
    rays_a: NDArray[np.float64], rays_b: NDArray[np.float64], b_from_a: Pose
) -> NDArray[np.float64]:
    """Return how far matched rays are from meeting, in units of the focal length.

    The distance of each point to the epipolar line of the other, in the plane at depth 1, the
    larger of the two photos. Infinite for rays that meet behind a camera, for rays that are NaN,
    and for all rays when the photos have one centre, since then nothing can be told.

    Args:
        rays_a: (n, 3) points at depth 1 in camera a.
        rays_b: (n, 3) their matches in camera b.
        b_from_a: relative pose; only its direction matters, not its length.
    """
    baseline = np.linalg.norm(b_from_a.translation)
    if baseline == 0:
        return np.full(len(rays_a), np.inf)
    translation = b_from_a.translation / baseline
    x, y, z = translation
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    essential = cross @ b_from_a.rotation
    lines_b, lines_a = rays_a @ essential.T, rays_b @ essential
    product = np.abs(np.einsum("ij,ij->i", rays_b, lines_b))
    with np.errstate(divide="ignore", invalid="ignore"):
        errors = product / np.minimum(
            np.linalg.norm(lines_a[:, :2], axis=1), np.linalg.norm(lines_b[:, :2], axis=1)
        )
    turned = rays_a @ b_from_a.rotation.T
    errors[~_in_front(turned, rays_b, translation)] = np.inf
    return np.asarray(np.where(np.isnan(errors), np.inf, errors))


def _in_front(
    a: NDArray[np.float64], b: NDArray[np.float64], translation: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Whether s a + translation = r b has s > 0 and r > 0, in the sense of least squares."""
    aa, bb, ab = (np.einsum("ij,ij->i", p, q) for p, q in ((a, a), (b, b), (a, b)))
    at, bt = a @ translation, b @ translation
    # The determinant of the normal equations is not negative; parallel rays meet at infinity.
    s = ab * bt - bb * at
    r = aa * bt - ab * at
    return np.asarray((s >= 0) & (r >= 0))
