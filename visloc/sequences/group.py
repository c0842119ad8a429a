"""Instants of which none can be localized alone, as one generalized camera."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from visloc.geometry import Pose
from visloc.options import RegistrationPreset
from visloc.pose.generalized import estimate_generalized_pose
from visloc.pose.motion import UncertainPose, chain
from visloc.pose.reprojection import MatchedView

# Instants belong to one camera while drift, at one standard deviation, shifts pixels by less than
# the largest error of an inlier.
_DRIFT_SHARE = 1.0
# A group has no more than about this many correspondences.
_MAX_CORRESPONDENCES = 3000
# Of thousands of wrong correspondences some dozen agree by chance: 0.6 % of 3000, measured. A group
# needs more, whatever is demanded of single photos.
_MIN_INLIER_RATIO = 0.03


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """Instants that agree on a pose.

    Attributes:
        reference: instant to which the pose belongs.
        rig_from_world: the pose, as good as the motion is exact.
    """

    first: int
    last: int
    reference: int
    rig_from_world: Pose


def find_groups(
    instants: Sequence[Sequence[MatchedView]],
    links: Sequence[UncertainPose],
    registration: RegistrationPreset,
    seed: int,
) -> Iterator[Group]:
    """Try overlapping groups of instants, small enough for the motion's drift.

    Args:
        links: N - 1 motions.
        registration: the gate, for all images of a group together.
    """
    from_first = carried(links)
    for first, last in _spans(instants, links, registration.max_error_px):
        reference = (first + last) // 2
        back = from_first[reference].inverse()
        views = [
            MatchedView(
                view.camera, view.cam_from_rig @ from_first[i] @ back, view.pixels, view.points
            )
            for i in range(first, last + 1)
            for view in instants[i]
        ]
        if first == last or sum(map(len, views)) < registration.min_inliers:
            continue  # what could not be localized alone will not be now
        views = _thinned(views, seed)
        pose = estimate_generalized_pose(views, max_error_px=registration.max_error_px, seed=seed)
        share = max(registration.min_inlier_ratio, _MIN_INLIER_RATIO)
        if pose is not None and pose.num_inliers >= share * sum(map(len, views)):
            yield Group(first, last, reference, pose.rig_from_world)


def carried(links: Sequence[UncertainPose]) -> list[Pose]:
    """The motion from the first instant to each of N, over N - 1 links."""
    motions = (link.pose for link in links)
    return list(
        itertools.accumulate(motions, lambda so_far, m: m @ so_far, initial=Pose.identity())
    )


def _spans(
    instants: Sequence[Sequence[MatchedView]], links: Sequence[UncertainPose], max_error_px: float
) -> Iterator[tuple[int, int]]:
    """The first and last instants of groups within which drift stays small."""
    views = [view for instant in instants for view in instant if len(view)]
    if not views:
        return
    focal = float(np.median([view.camera.focal_length for view in views]))
    # How far the points are is not known before the pose; how far apart they are comes near.
    spread = [np.median(np.linalg.norm(v.points - np.median(v.points, 0), axis=1)) for v in views]
    depth = max(float(np.median(spread)), 1e-3)

    def drifts(reference: int, end: int) -> bool:
        variance = np.diag(chain(links, reference, end).covariance)
        shift = focal * math.sqrt(max(variance[:3]) + max(variance[3:]) / depth**2)
        return shift > _DRIFT_SHARE * max_error_px

    first, last = 0, 0
    while True:
        while last + 1 < len(instants):
            reference = (first + last + 1) // 2
            if drifts(reference, first) or drifts(reference, last + 1):
                break
            last += 1
        yield first, last
        if last == len(instants) - 1:
            return
        first += (last - first + 1) // 2 or 1
        last = max(first, last)


def _thinned(views: Sequence[MatchedView], seed: int) -> list[MatchedView]:
    """The views with so few of their correspondences that RANSAC is done in a moment."""
    count = sum(map(len, views))
    if count <= _MAX_CORRESPONDENCES:
        return list(views)
    rng = np.random.default_rng(seed)
    share = _MAX_CORRESPONDENCES / count
    return [view.selected(rng.random(len(view)) < share) for view in views]
