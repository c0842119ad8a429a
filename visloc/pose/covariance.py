"""The covariance of a pose, from the residuals of its own inliers, and distances by it.

Poses are perturbed as R <- Exp(w) R, t <- t + dt; covariances are 6 x 6, w (rad) before dt.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from visloc.geometry import Pose, center_covariance
from visloc.pose.reprojection import MatchedView, has_derivative, linearized

# Poses of different photos disagree by this much for reasons that are in no covariance.
_MAP_STD_RAD, _MAP_STD = math.radians(0.1), 0.01
_MIN_POINTS = 4
_MIN_VARIANCE_PX2 = 1e-12
# Smallest eigenvalue of the unit-free information matrix, of largest diagonal 1.
_MIN_INFORMATION = 1e-9
_SANDWICH_SCATTER = 2.0
# Largest standard deviation of the logarithm of an unknown focal length. It is exceeded by a plane
# that is nearly parallel to the image. Then the pose's error is no longer linear in those of the
# pixels: in a Monte Carlo test with an exact principal point, the stated 95 % held 50 to 80 %.
_MAX_FOCAL_STD = 0.03
# If the focal length is unknown, so is the principal point. Its standard deviation about the centre
# of the picture, as a share of the longer side.
_PRINCIPAL_POINT_STD = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class PoseCovariance:
    """The covariance of a pose, and the part of it that comes from an unknown camera.

    Attributes:
        whole: (6, 6), all of it.
        of_camera: (6, 6), the part that an unknown principal point adds, whatever the matches are.
            None for a known camera.
    """

    whole: NDArray[np.float64]
    of_camera: NDArray[np.float64] | None


def pose_covariance(
    views: Sequence[MatchedView], rig_from_world: Pose, loss_scale_px: float
) -> PoseCovariance | None:
    """Return the covariance of a rig's pose that was refined on these inliers with a Cauchy loss.

    There are two classical estimates for an M-estimator. Huber's (Huber 1981, section 7.6) assumes
    one common spread of the residuals, and is steady with few points. The sandwich (Huber 1967,
    White 1980) is right when some landmarks scatter more than others. In every direction the
    wider one counts. (pycolmap's own covariance assumes one pixel of noise and counts rotation in
    half-angles.) Tests in tests/visloc/pose check it by Monte Carlo.

    Args:
        views: inliers only; some views may have none. Inliers at the very edge of the picture,
            where errors have no derivative, are left out. With an unknown focal length, the
            principal point may be off by a hundredth of the longer side.
        loss_scale_px: scale c of the loss c^2 / 2 log(1 + r^2 / c^2).

    Returns:
        The covariance of ``rig_from_world``. None if the inliers leave the pose undetermined, or
        an unknown focal length uncertain by more than 3 %, and with it the distance.
    """
    if not views:
        return None
    residuals, jacobian = linearized(views, rig_from_world, about=rig_from_world.translation)
    known = has_derivative(residuals, jacobian)
    residuals, jacobian = residuals[known], jacobian[known]
    num_points = len(residuals)
    if num_points < _MIN_POINTS:
        return None
    weight = 1.0 / (1.0 + np.sum(residuals**2, axis=1) / loss_scale_px**2)
    psi = weight[:, None] * residuals
    gradients = np.einsum("nai,na->ni", jacobian, psi)
    scatter = _squared(gradients)
    # The second derivative of the loss is weight - 2 psi psi^T / c^2.
    by_weight = np.sqrt(weight)[:, None, None] * jacobian
    num_parameters = jacobian.shape[2]
    curvature = _squared(by_weight.reshape(-1, num_parameters)) - 2.0 / loss_scale_px**2 * scatter

    spare = 2 * num_points - num_parameters
    slope = np.mean(weight**2)  # half the trace of the second derivative; 0 for huge errors
    root = None if slope == 0 else _root_of_inverse(_squared(jacobian.reshape(-1, num_parameters)))
    bread = _inverse(curvature)
    if root is None or bread is None:
        return None
    # Never quite zero: exact correspondences, as in tests, would leave nothing to compare.
    root *= math.sqrt(max(np.sum(psi**2) / spare, _MIN_VARIANCE_PX2)) / slope
    sandwich = bread @ scatter @ bread * (2 * num_points / spare)
    # The sandwich scatters by about 1 / sqrt(n) in each direction. Taking the wider of both would
    # be too wide by that in half of the directions, so it is subtracted first.
    wider = _wider(root, sandwich / (1.0 + _SANDWICH_SCATTER / math.sqrt(num_points)))
    if num_parameters == 6:
        return PoseCovariance(wider, None)
    if wider[6, 6] > _MAX_FOCAL_STD**2:
        return None
    # Projections move as the principal point does, and the best pose moves with them.
    moves = np.einsum("n,nai->ia", weight, jacobian)
    moves -= 2.0 / loss_scale_px**2 * np.einsum("ni,na->ia", gradients, psi)
    of_camera = _of_principal_point((bread @ moves)[:6], views)
    return PoseCovariance(wider[:6, :6] + of_camera, of_camera)


def _of_principal_point(
    by_point: NDArray[np.float64], views: Sequence[MatchedView]
) -> NDArray[np.float64]:
    """Return the covariance (6, 6) that an uncertain principal point adds.

    Args:
        by_point: (6, 2) derivative of the pose by the principal point.
    """
    (camera,) = (view.camera for view in views if len(view))
    std_px = _PRINCIPAL_POINT_STD * max(camera.width, camera.height)
    return np.asarray(std_px**2 * by_point @ by_point.T)


def _squared(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """The product rows^T rows (k, k) of rows (n, k)."""
    # Unlike a product of matrices, equal bits however many threads the linear algebra has.
    columns = np.ascontiguousarray(rows.T)
    return np.asarray(np.einsum("in,jn->ij", columns, columns))


def _inverse(information: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Inverse of a symmetric positive matrix, None when it is not clearly positive."""
    scaled = _without_units(information)
    if scaled is None:
        return None
    matrix, scale = scaled
    return np.asarray(np.linalg.inv(matrix) / np.outer(scale, scale))


def _root_of_inverse(information: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """A matrix whose product with its transpose is the inverse; None as ``_inverse``.

    Rounding may leave the inverse itself without a root: far from the origin, rotation and
    translation are nearly the same.
    """
    scaled = _without_units(information)
    if scaled is None:
        return None
    matrix, scale = scaled
    return np.asarray(np.linalg.inv(np.linalg.cholesky(matrix)).T / scale[:, None])


def _without_units(
    information: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """A symmetric matrix scaled to a diagonal of 1, and the scale (k,).

    None when it is not clearly positive. Rotation and translation have different units, which say
    nothing about the conditioning.
    """
    scale = np.sqrt(np.abs(np.diag(information)))
    if not (scale > 0).all():
        return None
    matrix = information / np.outer(scale, scale)
    return None if np.linalg.eigvalsh(matrix)[0] < _MIN_INFORMATION else (matrix, scale)


def _wider(root: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the smallest covariance that is at least ``root root^T`` and ``b``, on common axes."""
    inverse = np.linalg.inv(root)
    ratios, axes = np.linalg.eigh(inverse @ b @ inverse.T)
    half = root @ (axes * np.sqrt(np.maximum(ratios, 1.0)))
    return np.asarray(half @ half.T)


def mahalanobis2(
    a: Pose, covariance_a: NDArray[np.float64], b: Pose, covariance_b: NDArray[np.float64]
) -> float:
    """Return the squared distance, chi-square with six degrees of freedom; infinite when in doubt.

    Args:
        covariance_a: (6, 6) of rotation (rad) then translation, for R <- Exp(w) R and t <- t + dt.
        covariance_b: of ``b``; its errors are independent of those of ``a``.
    """
    floor = np.diag([_MAP_STD_RAD**2] * 3 + [_MAP_STD**2] * 3)
    return _distance2(
        a, b, center_covariance(a, covariance_a) + center_covariance(b, covariance_b) + floor
    )


def normalized_distance2(a: Pose, b: Pose, covariance_b: NDArray[np.float64]) -> float:
    """Return the squared distance of a pose from another, in units of that one's covariance alone.

    Arguments and result as of ``mahalanobis2``; errors of the map have no part in it.
    """
    return _distance2(a, b, center_covariance(b, covariance_b))


def _distance2(a: Pose, b: Pose, total: NDArray[np.float64]) -> float:
    """Return the squared distance in units of a covariance (6, 6) of rotation and centre.

    In these terms because far from the origin, t is not linear in the rotation.
    """
    difference = np.concatenate(
        [Rotation.from_matrix(a.rotation @ b.rotation.T).as_rotvec(), a.center - b.center]
    )
    try:
        squared = float(difference @ np.linalg.solve(total, difference))
    except np.linalg.LinAlgError:
        return math.inf
    # So far from the origin that rounding left no digits, it may be negative or no number.
    return squared if squared >= 0 else math.inf


def viewpoints_apart(
    rotations: NDArray[np.float64], centers: NDArray[np.float64], pose: Pose, reach: float
) -> NDArray[np.float64]:
    """How far viewpoints (n,) are from a pose, in radians.

    The sum of two angles by which the picture moves: that of the turn, and the parallax, that is,
    the distance between both viewpoints as seen from the scene.

    Args:
        rotations: (n, 3, 3) camera from world.
        centers: (n, 3) of the cameras.
        reach: distance from photos to what they see, above 0.
    """
    cosines = (np.einsum("nij,ij->n", rotations, pose.rotation) - 1.0) / 2.0
    angles = np.arccos(np.clip(cosines, -1.0, 1.0))
    return np.asarray(angles + np.linalg.norm(centers - pose.center, axis=1) / reach)
