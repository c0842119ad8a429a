"""The distance between two poses, in units of their uncertainty."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from visloc.geometry import Pose, center_covariance

# Poses of different photos disagree by this much for reasons that are in no covariance.
_MAP_STD_RAD, _MAP_STD = math.radians(0.1), 0.01


def mahalanobis2(
    a: Pose, covariance_a: NDArray[np.float64], b: Pose, covariance_b: NDArray[np.float64]
) -> float:
    """Return the squared distance, chi-square with six degrees of freedom; infinite when in doubt.

    Args:
        a: ``device_from_world``.
        covariance_a: (6, 6) of rotation (rad) then translation, for R <- Exp(w) R and t <- t + dt.
        b: as ``a``.
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
        pose: camera from world.
        reach: distance from photos to what they see, above 0.
    """
    cosines = (np.einsum("nij,ij->n", rotations, pose.rotation) - 1.0) / 2.0
    angles = np.arccos(np.clip(cosines, -1.0, 1.0))
    return np.asarray(angles + np.linalg.norm(centers - pose.center, axis=1) / reach)
