"""An accepted pose whose cameras may be off: what its photos say of them, and what is left."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from visloc.geometry import Camera
from visloc.localization.acceptance.gates import Problem
from visloc.options import Solver
from visloc.pose.camera_errors import PRIORS, LensEvidence, find_camera_errors
from visloc.pose.generalized import GeneralizedPose, refine_generalized_pose
from visloc.types import Uncertainty

# What earlier photos of a sequence said of a camera, by its id in the rig and its intrinsics.
CamerasSoFar = Mapping[tuple[str, Camera], LensEvidence]
NO_CAMERAS: CamerasSoFar = {}
# With corrected cameras, a pose explains no fewer matches than this part of those before.
_LEAST_KEPT = 0.9


def with_corrected_cameras(
    problem: Problem, pose: GeneralizedPose, sensors: Sequence[str], cameras: CamerasSoFar
) -> tuple[Problem, GeneralizedPose, CamerasSoFar]:
    """Correct cameras that the photos show to be off, and carry what is left of their errors.

    A map without a test of its own does not tell how much its matches say, so there cameras stay.

    Args:
        problem: the search.
        pose: its accepted pose.
        sensors: ids in the rig of the cameras of the views.
        cameras: what earlier photos said of them; what these say is added.
    """
    errors = problem.constraints.errors
    unknown = errors.uncertainty is Uncertainty.PHOTO_ONLY
    if unknown or pose.covariance is None or problem.options.solver is Solver.REGISTRATION:
        return problem, pose, cameras
    max_error_px = problem.registration.max_error_px
    used = [
        replace(view, camera=pose.camera or view.camera, focal_unknown=False)
        for view in problem.views
    ]
    keys = [(sensor, view.camera) for sensor, view in zip(sensors, used, strict=True)]
    earlier = [cameras.get(key) for key in keys]
    found = find_camera_errors(
        used,
        [PRIORS[source] for source in problem.sources],
        pose.rig_from_world,
        earlier=earlier,
        max_error_px=max_error_px,
        factor=errors.position_factor,
    )
    if found is None:
        return problem, pose, cameras
    if pose.camera is None:  # another photo is used with another one
        said = zip(keys, found.evidence, earlier, strict=True)
        cameras = {**cameras, **{key: now.with_earlier(old) for key, now, old in said if now}}
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
            widened = _widened(pose, found.of_camera + np.outer(apart, apart))
            return problem, widened, cameras
        best, views = replace(refined, probability=pose.probability), found.views
        if pose.camera is not None:  # found with the pose, also when matches are drawn again
            best = replace(best, camera=views[0].camera)
            views = (replace(views[0], focal_unknown=True),)
    return problem.of(views), _widened(best, found.of_camera), cameras


def _widened(pose: GeneralizedPose, of_camera: NDArray[np.float64]) -> GeneralizedPose:
    assert pose.covariance is not None
    before = 0.0 if pose.of_camera is None else pose.of_camera
    return replace(pose, covariance=pose.covariance - before + of_camera, of_camera=of_camera)
