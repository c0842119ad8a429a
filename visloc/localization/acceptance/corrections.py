"""What is corrected in an accepted pose: its cameras, and how far other draws of matches are off.

Decisions 0049 (matches drawn again) and 0055 (cameras have errors).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from visloc.geometry import Camera
from visloc.localization.acceptance.gates import Problem, asks_for_weak_poses
from visloc.localization.acceptance.judge import TIE_ANGLE, TIE_REACH_SHARE
from visloc.options import Solver
from visloc.pose.camera_errors import PRIORS, LensEvidence, find_camera_errors
from visloc.pose.covariance import normalized_distance2
from visloc.pose.generalized import GeneralizedPose, refine_generalized_pose
from visloc.pose.motion import largest_std
from visloc.pose.reprojection import MatchedView, reprojection_errors
from visloc.types import Reason, Refusal, Uncertainty

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


# The ring beyond the inlier threshold out to so many times it has the area of the disc within. If
# it holds more than this share of the inliers' number, right matches may lie beyond the threshold.
_RING, _CROWDED = math.sqrt(2.0), 0.1
# With so many inliers, other draws of matches that are not crowded agree.
_MANY_INLIERS = 300
# Other minima nearby explain matches that are so many thresholds off. What lies beyond would make
# each search take thirty times longer, and is of other places (``rivals``).
_DRAWN_WITHIN = 4.0
_REDRAWS = 8
# So many deviations of the draws must not reach another place.
_STDS = 2.0
# The median of chi-square with the six degrees of freedom of a pose.
_MEDIAN_CHI2_6 = float(chdtri(6, 0.5))


def with_redraws(
    problem: Problem, pose: GeneralizedPose, reach: float
) -> tuple[GeneralizedPose, Refusal | None]:
    """Widen the covariance of an accepted pose to what other draws of its matches say.

    Asked of poses with few inliers, or with many matches just beyond the inlier threshold.

    Args:
        reach: how far the map's photos see, units of the world.

    Returns:
        The pose, and ``uncertain_pose`` if draws leave open where it is: if half of them lead to no
        pose, or if two deviations of their scatter reach another place. A caller who asks for weak
        poses gets the wider covariance in the second case.
    """
    if pose.covariance is None or not _is_asked(problem, pose):
        return pose, None
    factor = widening(problem, pose)
    if math.isinf(factor):
        return pose, _uncertain("at least half of them lead to no pose")
    of_camera = None if pose.of_camera is None else factor * pose.of_camera
    wider = replace(pose, covariance=factor * pose.covariance, of_camera=of_camera)
    if factor > 1.0 and not asks_for_weak_poses(problem.options):
        std = largest_std(wider.rig_from_world, factor * pose.covariance)
        turn_std = _largest_turn_std(factor * pose.covariance)
        if _STDS * std > TIE_REACH_SHARE * reach or _STDS * turn_std > TIE_ANGLE:
            return pose, _uncertain(f"they scatter by {std:.2g} (map's unit), {turn_std:.2g} rad")
    return wider, None


def _uncertain(why: str) -> Refusal:
    return Refusal(
        "gate",
        Reason.UNCERTAIN_POSE,
        f"the pose was searched again with {_REDRAWS} other draws of its matches: {why}; the photo "
        "is blurred, or shows too little of the map: take one with more of the scene",
    )


def _largest_turn_std(covariance: NDArray[np.float64]) -> float:
    return math.sqrt(max(float(np.linalg.eigvalsh(covariance[:3, :3])[-1]), 0.0))


def _is_asked(problem: Problem, pose: GeneralizedPose) -> bool:
    return pose.num_inliers < _MANY_INLIERS or crowding(problem, pose) > _CROWDED


def crowding(problem: Problem, pose: GeneralizedPose) -> float:
    """Return the number of matches just beyond the inlier threshold, as a share of the inliers."""
    threshold = problem.registration.max_error_px
    beyond = sum(
        int(((errors > threshold) & (errors <= _RING * threshold)).sum())
        for errors in _errors(problem.views, pose)
    )
    return beyond / pose.num_inliers


def widening(problem: Problem, pose: GeneralizedPose) -> float:
    """Return by how much the covariance of a pose must grow, at least 1.

    The search is repeated on the matches that lie near the pose, as many, drawn with replacement.
    The result is the median squared distance of these poses from ``pose``, in units of its
    covariance, over the median of chi-square with six degrees of freedom; infinite if half of the
    draws lead to no pose. (The mean would grow a hundredfold where one draw of eight finds another
    place.)
    """
    assert pose.covariance is not None
    within = _DRAWN_WITHIN * problem.registration.max_error_px
    views = problem.near_prior()
    views = [
        view.selected(errors <= within)
        for view, errors in zip(views, _errors(views, pose), strict=True)
    ]
    random = np.random.default_rng(problem.options.seed)
    distances = []
    for redraw in range(_REDRAWS):
        rows = [np.sort(random.integers(len(view), size=len(view))) for view in views]
        drawn = [view.selected(chosen) for view, chosen in zip(views, rows, strict=True)]
        found = problem.of(drawn).solve(seed=redraw)
        distances.append(
            math.inf
            if found is None
            else normalized_distance2(found.rig_from_world, pose.rig_from_world, pose.covariance)
        )
    return max(1.0, float(np.median(distances)) / _MEDIAN_CHI2_6)


def _errors(views: Sequence[MatchedView], pose: GeneralizedPose) -> list[NDArray[np.float64]]:
    """Return the reprojection errors of each view; NaN, behind the camera, is beyond all limits."""
    found = []
    for view in views:
        seen = view if pose.camera is None else replace(view, camera=pose.camera)
        with np.errstate(invalid="ignore"):  # landmarks that are no numbers
            found.append(reprojection_errors(seen, pose.rig_from_world))
    return found
