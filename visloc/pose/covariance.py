"""How uncertain a pose is, from the residuals of its own inliers.

Poses are perturbed as R <- Exp(w) R, t <- t + dt; covariances are 6 x 6, w (rad) before dt.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from visloc.geometry import Camera, Pose, cross_matrix
from visloc.pose.colmap import project
from visloc.pose.views import MatchedView

_MIN_POINTS = 4
_MIN_VARIANCE_PX2 = 1e-12
# Smallest eigenvalue of the unit-free information matrix, of largest diagonal 1.
_MIN_INFORMATION = 1e-9
_SANDWICH_SCATTER = 2.0


def pose_covariance(
    views: Sequence[MatchedView], rig_from_world: Pose, loss_scale_px: float
) -> NDArray[np.float64] | None:
    """Covariance of a rig's pose that was refined on these inliers with a Cauchy loss.

    Two classical estimates for an M-estimator: Huber's for residuals of one common spread
    (Huber 1981, section 7.6: scaled by the residuals themselves; steady with few points), and
    the sandwich of Huber (1967) and White (1980), right when some landmarks scatter more than
    others. Along every direction the wider one counts, so that the answer does not claim more
    than either supports. pycolmap's own covariance assumes one pixel of noise and counts
    rotation in half-angles. Checked by Monte Carlo in tests/visloc/pose.

    Args:
        views: inliers only; views without any are fine.
        rig_from_world: the refined pose.
        loss_scale_px: scale c of the loss c^2 log(1 + r^2 / c^2).

    Returns:
        (6, 6) of ``rig_from_world``, or None when the inliers leave the pose undetermined.
    """
    num_points = sum(len(view) for view in views)
    if num_points < _MIN_POINTS:
        return None
    linear = [_linearize(view, rig_from_world) for view in views]
    residuals = np.concatenate([view_residuals for view_residuals, _ in linear])
    jacobian = np.concatenate([view_jacobian for _, view_jacobian in linear])
    weight = 1.0 / (1.0 + np.sum(residuals**2, axis=1) / loss_scale_px**2)
    outer = residuals[:, :, None] * residuals[:, None, :]
    curvature = (
        weight[:, None, None] * np.eye(2)
        - (2.0 * (weight / loss_scale_px) ** 2)[:, None, None] * outer
    )
    psi = weight[:, None] * residuals

    num_residuals = 2 * num_points
    spare = num_residuals - 6
    slope = np.trace(curvature, axis1=1, axis2=2).sum() / num_residuals
    if not (np.isfinite(jacobian).all() and slope > 0):
        return None
    common = _inverse(np.einsum("nai,naj->ij", jacobian, jacobian))
    bread = _inverse(np.einsum("nai,nab,nbj->ij", jacobian, curvature, jacobian))
    if common is None or bread is None:
        return None
    # Never quite zero: exact correspondences, as in tests, would leave nothing to compare.
    common *= max(np.sum(psi**2) / spare, _MIN_VARIANCE_PX2) / slope**2
    gradients = np.einsum("nai,na->ni", jacobian, psi)
    sandwich = bread @ (gradients.T @ gradients) @ bread * (num_residuals / spare)
    # The sandwich scatters by about 1 / sqrt(n) in each direction: the largest of both would be
    # too wide by that in half of them, were it not taken off first.
    return _wider(common, sandwich / (1.0 + _SANDWICH_SCATTER / math.sqrt(num_points)))


def position_covariance(
    cam_from_world: Pose, covariance: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Covariance (3, 3) of the camera centre in the world, from that of the pose (6, 6).

    The centre is -R^T t; moving R by Exp(w) and t by dt moves it by -R^T (dt + [t] w), with [t]
    the matrix of the cross product.
    """
    jacobian = -cam_from_world.rotation.T @ np.hstack(
        [cross_matrix(cam_from_world.translation), np.eye(3)]
    )
    return np.asarray(jacobian @ covariance @ jacobian.T)


def with_origin(
    cam_from_local: Pose, covariance: NDArray[np.float64], origin: NDArray[np.float64]
) -> tuple[Pose, NDArray[np.float64]]:
    """Move a pose found in coordinates relative to ``origin`` (3,) to the world.

    x_local = x_world - origin, so t_world = t_local - R origin; the covariance of t_world
    gains the part that the rotation causes at that distance.
    """
    offset = cam_from_local.rotation @ origin
    pose = Pose(cam_from_local.rotation, cam_from_local.translation - offset)
    jacobian = np.eye(6)
    jacobian[3:, :3] = cross_matrix(offset)
    return pose, jacobian @ covariance @ jacobian.T


def _linearize(
    view: MatchedView, rig_from_world: Pose
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Residuals (n, 2) of a view in pixels, and their derivative (n, 2, 6) by the rig's pose."""
    in_rig = rig_from_world.apply(view.points)
    seen = view.cam_from_rig.apply(in_rig)
    motion = _motion_jacobian(in_rig - rig_from_world.translation)
    jacobian = _projection_jacobian(view.camera, seen) @ view.cam_from_rig.rotation @ motion
    return project(view.camera, seen) - view.pixels, jacobian


def _motion_jacobian(rotated: NDArray[np.float64]) -> NDArray[np.float64]:
    """Derivative (n, 3, 6) of Exp(w) R x + t + dt by (w, dt), given R x (n, 3)."""
    jacobian = np.zeros((len(rotated), 3, 6))
    x, y, z = rotated.T
    jacobian[:, 0, 1], jacobian[:, 0, 2] = z, -y
    jacobian[:, 1, 0], jacobian[:, 1, 2] = -z, x
    jacobian[:, 2, 0], jacobian[:, 2, 1] = y, -x
    jacobian[:, :, 3:] = np.eye(3)
    return jacobian


def _projection_jacobian(camera: Camera, seen: NDArray[np.float64]) -> NDArray[np.float64]:
    """Derivative (n, 2, 3) of the pixel by the point in the camera's frame, numerically.

    Central differences work for every camera model; their error is about 1e-9 relative.
    """
    step = 1e-5 * np.linalg.norm(seen, axis=1)
    columns = []
    for axis in np.eye(3):
        shift = step[:, None] * axis
        difference = project(camera, seen + shift) - project(camera, seen - shift)
        columns.append(difference / (2 * step[:, None]))
    return np.stack(columns, axis=2)


def _inverse(information: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Inverse of a symmetric positive matrix, None when it is not clearly positive."""
    # Rotation and translation have different units: judge the conditioning without them.
    scale = np.sqrt(np.abs(np.diag(information)))
    if not (scale > 0).all():
        return None
    units = np.outer(scale, scale)
    if np.linalg.eigvalsh(information / units)[0] < _MIN_INFORMATION:
        return None
    return np.asarray(np.linalg.inv(information / units) / units)


def _wider(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """The smallest covariance that is at least ``a`` and ``b`` along their common axes."""
    scale = np.sqrt(np.diag(a))
    root = scale[:, None] * np.linalg.cholesky(a / np.outer(scale, scale))
    inverse = np.linalg.inv(root)
    ratios, axes = np.linalg.eigh(inverse @ b @ inverse.T)
    half = root @ (axes * np.sqrt(np.maximum(ratios, 1.0)))
    return np.asarray(half @ half.T)
