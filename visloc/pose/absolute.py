"""The pose of one camera from 2D-3D correspondences."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import PIL.Image  # noqa: F401  before pycolmap, see visloc.pose.colmap
import pycolmap
from numpy.typing import NDArray

from visloc.geometry import Camera, Pose
from visloc.pose.colmap import colmap_camera, pose_from_colmap, project
from visloc.pose.covariance import pose_covariance

# Beyond this many trials a pose with 8 % inliers has been found with 99 % probability; a photo
# of another place should not cost seconds.
MAX_TRIALS = 10_000
# Scale of the Cauchy loss in the refinement. Landmarks from depth maps scatter by a few pixels.
LOSS_SCALE_PX = 3.0
_SOLVER_MIN_POINTS = 4


@dataclass(frozen=True, slots=True, eq=False)
class AbsolutePose:
    """A refined pose and what supports it.

    Attributes:
        cam_from_world: in the frame of the points that were given.
        inliers: (n,) bool, reprojection error within the threshold under this pose.
        covariance: (6, 6), rotation (rad) then translation, for R <- Exp(w) R and t <- t + dt;
            None when the inliers leave the pose undetermined (collinear points, for one).
    """

    cam_from_world: Pose
    inliers: NDArray[np.bool_]
    covariance: NDArray[np.float64] | None


def estimate_absolute_pose(
    pixels: NDArray[np.float64],
    points: NDArray[np.float64],
    camera: Camera,
    *,
    max_error_px: float,
    seed: int,
) -> AbsolutePose | None:
    """Solve for the pose with LO-RANSAC (P3P) and refine it on the inliers (pycolmap).

    Args:
        pixels: (n, 2) in the camera's image.
        points: (n, 3) in a world frame whose numbers are not large.
        camera: intrinsics, kept fixed.
        max_error_px: largest reprojection error of an inlier.
        seed: equal seeds give equal bits.

    Returns:
        The pose, or None when there are fewer than four points or none was found. The solver
        finds a pose in almost anything: the caller must judge the inliers.
    """
    if len(pixels) < _SOLVER_MIN_POINTS:
        return None
    estimation = pycolmap.AbsolutePoseEstimationOptions()
    estimation.ransac.max_error = max_error_px
    estimation.ransac.max_num_trials = MAX_TRIALS
    estimation.ransac.random_seed = seed
    refinement = pycolmap.AbsolutePoseRefinementOptions()
    refinement.loss_function_scale = LOSS_SCALE_PX
    solved = pycolmap.estimate_and_refine_absolute_pose(
        pixels, points, colmap_camera(camera), estimation, refinement
    )
    if solved is None:
        return None
    cam_from_world = pose_from_colmap(solved["cam_from_world"])
    errors = reprojection_errors(camera, cam_from_world, pixels, points)
    inliers = errors <= max_error_px  # False for NaN: behind the camera
    covariance = pose_covariance(
        camera, cam_from_world, pixels[inliers], points[inliers], LOSS_SCALE_PX
    )
    return AbsolutePose(cam_from_world, inliers, covariance)


def reprojection_errors(
    camera: Camera,
    cam_from_world: Pose,
    pixels: NDArray[np.float64],
    points: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the distances (n,) in pixels; NaN for points behind the camera."""
    return np.asarray(
        np.linalg.norm(project(camera, cam_from_world.apply(points)) - pixels, axis=1)
    )
