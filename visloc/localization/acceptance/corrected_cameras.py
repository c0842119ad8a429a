"""An accepted pose whose cameras may be off: what its photos say of them, and what is left."""

from __future__ import annotations

from dataclasses import replace

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
            return problem, pose
        best, views = replace(refined, probability=pose.probability), found.views
        if pose.camera is not None:  # found with the pose, also when matches are drawn again
            best = replace(best, camera=views[0].camera)
            views = (replace(views[0], focal_unknown=True),)
    assert best.covariance is not None
    covariance = best.covariance + found.of_camera
    return problem.of(views), replace(best, covariance=covariance, of_camera=found.of_camera)
