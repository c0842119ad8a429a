"""A photo's pose as COLMAP's image_registrator finds it, for comparisons with the paper."""

from __future__ import annotations

import numpy as np
import PIL.Image  # noqa: F401  before pycolmap, see visloc.pose.reprojection
import pycolmap
from numpy.typing import NDArray

from visloc.geometry import Pose
from visloc.pose.refinement import MIN_INLIERS
from visloc.pose.reprojection import MatchedView, colmap_camera, pose_from_colmap

# COLMAP's own, for poses.
REGISTRATION_LOSS_SCALE_PX = 1.0


def register(
    view: MatchedView, *, max_error_px: float, seed: int
) -> tuple[Pose, NDArray[np.bool_]] | None:
    """Search among all correspondences with COLMAP's options, and refine with its loss.

    P3P in LO-RANSAC, confidence 0.99999, 100 to 10 000 trials, then a Cauchy loss of 1 px over the
    inliers that RANSAC found, which stay what they are. The camera is taken as it is, as with
    ba_refine_focal_length = 0 of table 2 in Humenberger et al. 2020, so that a guess must not come
    here (``visloc.localization.solving`` refuses it). COLMAP also ends the search
    once a pose of the least share of inliers had been found; the gate refuses those anyway.

    Returns:
        ``rig_from_world`` and (n,) its inliers, or None when there are fewer than four.
    """
    usable = np.isfinite(view.pixels).all(axis=1) & np.isfinite(view.points).all(axis=1)
    pixels, points = view.pixels[usable], view.points[usable]
    if len(pixels) < MIN_INLIERS:
        return None
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = max_error_px
    options.ransac.confidence = 0.99999
    options.ransac.min_num_trials = 100
    options.ransac.max_num_trials = 10_000
    options.ransac.random_seed = seed
    camera = colmap_camera(view.camera)
    found = pycolmap.estimate_absolute_pose(pixels, points, camera, options)
    if found is None or found["num_inliers"] < MIN_INLIERS:
        return None
    refinement = pycolmap.AbsolutePoseRefinementOptions()
    refinement.loss_function_scale = REGISTRATION_LOSS_SCALE_PX
    refined = pycolmap.refine_absolute_pose(
        found["cam_from_world"], pixels, points, found["inlier_mask"], camera, refinement
    )
    if refined is None:
        return None
    inliers = np.zeros(len(view), dtype=np.bool_)
    inliers[usable] = found["inlier_mask"]
    return view.cam_from_rig.inverse() @ pose_from_colmap(refined["cam_from_world"]), inliers
