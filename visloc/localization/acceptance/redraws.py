"""How far a pose moves when its matches are drawn again: the bootstrap of Efron (1979).

The covariance of a pose describes one minimum of the loss, with the inliers that it has there. Of a
blurred photo, errors of right matches are as large as the inlier threshold. Then another choice of
inliers leads to another minimum that explains as much, several stated deviations away
(docs/decisions/0049-matches-drawn-again.md).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from visloc.localization.acceptance.gates import Problem
from visloc.pose.distance import normalized_distance2
from visloc.pose.generalized import GeneralizedPose
from visloc.pose.reprojection import reprojection_errors
from visloc.types import Reason, Refusal

# The ring beyond the inlier threshold out to so many times it has the area of the disc within. If
# it holds more than this share of the inliers' number, right matches may lie beyond the threshold.
_RING, _CROWDED = math.sqrt(2.0), 0.1
_REDRAWS = 8
# The median of chi-square with the six degrees of freedom of a pose.
_MEDIAN_CHI2_6 = float(chdtri(6, 0.5))


def with_redraws(problem: Problem, pose: GeneralizedPose) -> tuple[GeneralizedPose, Refusal | None]:
    """Widen the covariance of an accepted pose to what other draws of its matches say.

    Asked only of poses with many matches just beyond the inlier threshold, as each of the eight
    draws takes a search.

    Returns:
        The pose, and ``uncertain_pose`` if half of the draws or more lead to no pose.
    """
    if pose.covariance is None or crowding(problem, pose) <= _CROWDED:
        return pose, None
    factor = widening(problem, pose)
    if math.isinf(factor):
        return pose, Refusal(
            "gate",
            Reason.UNCERTAIN_POSE,
            f"at least half of {_REDRAWS} other draws of the matches lead to no pose: the photo "
            "is blurred, or shows another place",
        )
    of_camera = None if pose.of_camera is None else factor * pose.of_camera
    return replace(pose, covariance=factor * pose.covariance, of_camera=of_camera), None


def crowding(problem: Problem, pose: GeneralizedPose) -> float:
    """Return the number of matches just beyond the inlier threshold, as a share of the inliers."""
    threshold = problem.registration.max_error_px
    beyond = 0
    for view in problem.views:
        seen = view if pose.camera is None else replace(view, camera=pose.camera)
        errors = reprojection_errors(seen, pose.rig_from_world)  # NaN lies nowhere
        beyond += int(((errors > threshold) & (errors <= _RING * threshold)).sum())
    return beyond / pose.num_inliers


def widening(problem: Problem, pose: GeneralizedPose) -> float:
    """Return by how much the covariance of a pose must grow, at least 1.

    The search is repeated with as many matches, drawn with replacement. The result is the median
    squared distance of these poses from ``pose``, in units of its covariance, over the median of
    chi-square with six degrees of freedom; infinite if half of the draws lead to no pose. (The
    mean would grow a hundredfold where one draw of eight finds another place.)
    """
    assert pose.covariance is not None
    views = problem.near_prior()
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
