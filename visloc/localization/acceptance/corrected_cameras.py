"""An accepted pose whose cameras may be off: what its photos say of them, and what is left."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from visloc.localization.acceptance.gates import Problem
from visloc.options import Solver
from visloc.pose.camera_errors import PRIORS, find_camera_errors
from visloc.pose.generalized import GeneralizedPose, refine_generalized_pose
from visloc.types import Uncertainty

# With corrected cameras, a pose explains no fewer matches than this part of those before.
_LEAST_KEPT = 0.9


def with_corrected_cameras(
    problem: Problem, pose: GeneralizedPose
) -> tuple[Problem, GeneralizedPose]:
    """Correct cameras that the photos show to be off, and carry what is left of their errors.

    A map without a test of its own does not tell how much its matches say, so there cameras stay.
    """
    errors = problem.constraints.errors
    unknown = errors.uncertainty is Uncertainty.PHOTO_ONLY
    if unknown or pose.covariance is None or problem.options.solver is Solver.REGISTRATION:
        return problem, pose
    max_error_px = problem.registration.max_error_px
    found = find_camera_errors(
        [
            replace(view, camera=pose.camera or view.camera, focal_unknown=False)
            for view in problem.views
        ],
        [PRIORS[source] for source in problem.sources],
        pose.rig_from_world,
        max_error_px=max_error_px,
        factor=errors.position_factor,
    )
    if found is None:
        return problem, pose
    best, views = pose, problem.views
    if found.corrected:
        refined = refine_generalized_pose(
            found.views, found.rig_from_world, max_error_px=max_error_px
        )
        if (
            refined is None
            or refined.covariance is None
            or refined.num_inliers < _LEAST_KEPT * pose.num_inliers
        ):
            # It is off all the same.
            a, b = found.rig_from_world, pose.rig_from_world
            turned = Rotation.from_matrix(a.rotation @ b.rotation.T).as_rotvec()
            apart = np.concatenate([turned, a.translation - b.translation])
            return problem, _widened(pose, found.of_camera + np.outer(apart, apart))
        best, views = replace(refined, probability=pose.probability), found.views
        if pose.camera is not None:  # found with the pose, also when matches are drawn again
            best = replace(best, camera=views[0].camera)
            views = (replace(views[0], focal_unknown=True),)
    return problem.of(views), _widened(best, found.of_camera)


def _widened(pose: GeneralizedPose, of_camera: NDArray[np.float64]) -> GeneralizedPose:
    assert pose.covariance is not None
    before = 0.0 if pose.of_camera is None else pose.of_camera
    return replace(pose, covariance=pose.covariance - before + of_camera, of_camera=of_camera)
