"""Convert a pose and its covariance: to the camera's centre, to another origin, to another frame.

Conventions as in ``covariance``: R <- Exp(w) R, t <- t + dt; 6 x 6, w (rad) before dt.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from visloc.geometry import Pose, Similarity, cross_matrix


def position_covariance(
    cam_from_world: Pose, covariance: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the covariance (3, 3) of the camera centre in the world, from that of the pose (6, 6).

    The centre is -R^T t. If R moves by Exp(w) and t by dt, it moves by -R^T (dt + [t] w), where [t]
    is the matrix of the cross product.
    """
    jacobian = -cam_from_world.rotation.T @ np.hstack(
        [cross_matrix(cam_from_world.translation), np.eye(3)]
    )
    return np.asarray(jacobian @ covariance @ jacobian.T)


def with_origin(
    cam_from_local: Pose, covariance: NDArray[np.float64], origin: NDArray[np.float64]
) -> tuple[Pose, NDArray[np.float64]]:
    """Move a pose found in coordinates relative to ``origin`` (3,) to the world.

    x_local = x_world - origin, so t_world = t_local - R origin. The covariance of t_world grows by
    the rotation's error times the distance of the origin.
    """
    jacobian = np.eye(6)
    jacobian[3:, :3] = cross_matrix(cam_from_local.rotation @ origin)
    return moved_origin(cam_from_local, origin), jacobian @ covariance @ jacobian.T


def moved_origin(cam_from_local: Pose, origin: NDArray[np.float64]) -> Pose:
    """Move a pose found in coordinates relative to ``origin`` (3,) to the world."""
    rotation = cam_from_local.rotation
    return Pose(rotation, cam_from_local.translation - rotation @ origin)


def moved_pose(
    device_from_b: Pose, covariance: NDArray[np.float64], a_from_b: Similarity
) -> tuple[Pose, NDArray[np.float64]]:
    """Move a pose and its covariance (6, 6) to another frame and unit.

    The translation is t_a = scale t_b - R_a t, with R_a and t_a of the result and t of
    ``a_from_b``. So its error has two parts: that of t_b, and the rotation's times the distance
    between the origins.
    """
    pose = a_from_b.move(device_from_b)
    jacobian = np.eye(6)
    jacobian[3:, 3:] *= a_from_b.scale
    jacobian[3:, :3] = cross_matrix(pose.rotation @ a_from_b.translation)
    moved = jacobian @ covariance @ jacobian.T
    return pose, (moved + moved.T) / 2


def largest_std(pose: Pose, covariance: NDArray[np.float64]) -> float:
    """Return the standard deviation of a device's position along its worst axis."""
    return math.sqrt(max(float(np.linalg.eigvalsh(position_covariance(pose, covariance))[-1]), 0.0))
