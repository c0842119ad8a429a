"""The instants of a sequence solved together, with relative motion as the rig that holds them.

Measured poses are joined by the motion between them, and instants whose own images do not do get
the pose that their neighbours and the motion give. Where no instant was measured, the images of
many are one generalized camera, as Humenberger et al. 2020 have it for the cameras of a rig.

Motion is believed only as far as measured poses do not contradict it: between two that do, nothing
is filled, and both stay as they were measured.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visloc.geometry import Pose
from visloc.pose.colmap import project
from visloc.pose.generalized import GeneralizedPose, estimate_generalized_pose
from visloc.pose.motion import (
    RelativeMotion,
    UncertainPose,
    chain,
    difference,
    link_from_motion,
)
from visloc.pose.pose_graph import Chain, error_scale, solve_chain
from visloc.pose.views import MatchedView
from visloc.types import RegistrationPreset

__all__ = ["RelativeMotion", "WindowInstant", "WindowPose", "solve_window"]

# Scale of the Cauchy loss, as in the refinement of single poses.
_LOSS_SCALE_PX = 3.0
# Chi-square quantiles for six degrees of freedom.
_CHI2_99 = 16.81
_CHI2_999 = 22.46
# A measured pose may be off by more than its covariance tells, because maps have errors that its
# points share: 0.1 degrees and 1 cm. A contradiction must be beyond that.
_MAP_ERROR = np.diag([math.radians(0.1) ** 2] * 3 + [0.01**2] * 3)
# Fewer inliers under a pose that others gave are chance: blurred images have such, too.
_MIN_OWN_INLIERS = 8
# In a group that passed the gate together, three of the consensus are enough.
_MIN_GROUP_INLIERS = 3
# Instants belong to one generalized camera while drift shifts pixels by less than this share of
# the largest error of an inlier, at one standard deviation.
_DRIFT_SHARE = 0.5
# RANSAC of a group looks at no more than about this many correspondences.
_MAX_GROUP_CORRESPONDENCES = 3000
_MAX_ROUNDS = 8
_SCALE_SETTLED = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class WindowInstant:
    """The images of one instant.

    Attributes:
        views: one for each image, matched against the map; there may be none.
        alone: the pose that they gave on their own, when it passed the gate.
    """

    views: tuple[MatchedView, ...]
    alone: GeneralizedPose | None


@dataclass(frozen=True, slots=True, eq=False)
class WindowPose:
    """The pose of one instant, from all that the window knows.

    Attributes:
        rig_from_world: in the frame of the views' points.
        covariance: (6, 6) of rotation (rad) then translation, for R <- Exp(w) R and t <- t + dt.
        inliers: per view, (n,) bool, reprojection error within the threshold.
        measured: the instant's own images measured it: they support it as the gate demands.
            Otherwise it rests on other instants and the motion.
    """

    rig_from_world: Pose
    covariance: NDArray[np.float64]
    inliers: tuple[NDArray[np.bool_], ...]
    measured: bool


def solve_window(
    instants: Sequence[WindowInstant],
    motions: Sequence[RelativeMotion | None],
    *,
    registration: RegistrationPreset,
    seed: int,
) -> list[WindowPose | None]:
    """Solve for the poses of N instants at once.

    1. Where motion is unknown, the window is cut. Consecutive measured poses and the motion
       between them are compared (chi-square, 0.999): where they contradict each other, the motion
       is not used, and nothing between them is filled; beyond the outermost measured poses of such
       a part nothing is filled either. A measured pose that contradicts both neighbours while
       these agree is taken for a look-alike place: it is not used, and its instant is filled.
       Motion that agrees only within the map's own error, but not within its stated covariance
       (0.99), counts with a covariance made larger accordingly.
    2. A part without measured poses is tried as one generalized camera, in groups small enough
       for the motion's drift.
    3. All poses of a part are solved together (``visloc.pose.pose_graph``): measured ones with
       their covariance, motion with its own, and the pixels of instants that were not measured
       but agree with the pose that the others give them.

    A wrong motion that no measured pose contradicts, as beyond the last one, cannot be seen:
    there, the covariance is as honest as that of the motion.

    Args:
        instants: consecutive, N.
        motions: N - 1, from instant i to i + 1; None where unknown.
        registration: the gate, and the largest reprojection error of an inlier.
        seed: of RANSAC; equal seeds give equal bits.

    Returns:
        For each instant its pose, or None when nothing supports one. Measured poses move within
        their uncertainty only.
    """
    if len(motions) != max(len(instants) - 1, 0):
        raise ValueError(f"{len(instants)} instants with {len(motions)} motions")
    links = [link_from_motion(motion) for motion in motions]
    found: list[WindowPose | None] = []
    start = 0
    for end in range(1, len(instants) + 1):
        if end == len(instants) or links[end - 1] is None:
            inside = [link for link in links[start : end - 1] if link is not None]
            found += _solve_segment(instants[start:end], inside, registration, seed)
            start = end
    return found


def _solve_segment(
    instants: Sequence[WindowInstant],
    links: Sequence[UncertainPose],
    registration: RegistrationPreset,
    seed: int,
) -> list[WindowPose | None]:
    """Solve for instants that motion links without a gap."""
    measured = _measured_poses(instants)
    if not measured:
        return _solve_unmeasured(instants, links, registration, seed)
    found: list[WindowPose | None] = [
        None
        if instant.alone is None or instant.alone.covariance is None
        else WindowPose(
            instant.alone.rig_from_world, instant.alone.covariance, instant.alone.inliers, True
        )
        for instant in instants
    ]
    anchors = _without_outliers(sorted(measured), measured, links)
    for i in set(measured) - set(anchors):
        found[i] = None
    pieces, factors = _agreeing_pieces(anchors, measured, links)
    if len(pieces) == 1:  # nothing contradicts the motion: it may be followed to the ends
        pieces = [(0, len(instants) - 1)]
    ends = max(factors.values(), default=1.0)
    scaled = [link.scaled(factors.get(i, ends)) for i, link in enumerate(links)]
    for first, last in pieces:
        inside = range(first, last + 1)
        if len(inside) == 1:
            continue
        known = {i - first: measured[i] for i in anchors if i in inside}
        some = instants[first : last + 1]
        between = scaled[first:last]
        start = _propagated({i: pose.pose for i, pose in known.items()}, between)
        solved = _solve_together(some, between, known, start, {}, registration)
        if solved is not None:
            for i, pose in zip(inside, solved, strict=True):
                # What passed on its own is not lost when an inlier or two leave the threshold.
                if pose.measured or i not in anchors:
                    found[i] = pose
    return found


def _measured_poses(instants: Sequence[WindowInstant]) -> dict[int, UncertainPose]:
    """The poses that instants have on their own, by instant."""
    return {
        i: UncertainPose.from_additive(instant.alone.rig_from_world, instant.alone.covariance)
        for i, instant in enumerate(instants)
        if instant.alone is not None and instant.alone.covariance is not None
    }


def _disagreement(
    a: int, b: int, measured: dict[int, UncertainPose], links: Sequence[UncertainPose]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """How the measured pose b differs from a moved on (6,), and the covariances (6, 6) of that.

    The first is due to the two measured poses, the second to the motion.
    """
    motion = chain(links, a, b)
    predicted = UncertainPose(motion.pose, np.zeros((6, 6))) @ measured[a]
    poses = predicted.covariance + measured[b].covariance
    return difference(measured[b].pose, predicted.pose), poses, motion.covariance


def _contradict(
    a: int, b: int, measured: dict[int, UncertainPose], links: Sequence[UncertainPose]
) -> bool:
    """Whether two measured poses and the motion between them cannot all be right."""
    error, poses, motion = _disagreement(a, b, measured, links)
    return _chi2(error, poses + motion + 2.0 * _MAP_ERROR) > _CHI2_999


def _chi2(error: NDArray[np.float64], covariance: NDArray[np.float64]) -> float:
    return float(error @ np.linalg.solve(covariance, error))


def _without_outliers(
    anchors: Sequence[int], measured: dict[int, UncertainPose], links: Sequence[UncertainPose]
) -> list[int]:
    """Leave out those that contradict both neighbours while these agree with each other."""
    kept = list(anchors)
    i = 1
    while i < len(kept) - 1:
        before, this, after = kept[i - 1 : i + 2]
        if (
            _contradict(before, this, measured, links)
            and _contradict(this, after, measured, links)
            and not _contradict(before, after, measured, links)
        ):
            del kept[i]
        else:
            i += 1
    return kept


def _agreeing_pieces(
    anchors: Sequence[int], measured: dict[int, UncertainPose], links: Sequence[UncertainPose]
) -> tuple[list[tuple[int, int]], dict[int, float]]:
    """Cut where consecutive anchors contradict the motion.

    Returns:
        The first and last instant of each piece, and for each link between agreeing anchors the
        factor by which its covariance is too small.
    """
    pieces = [(anchors[0], anchors[0])]
    factors: dict[int, float] = {}
    for a, b in itertools.pairwise(anchors):
        if _contradict(a, b, measured, links):
            pieces.append((b, b))
            continue
        pieces[-1] = (pieces[-1][0], b)
        error, poses, motion = _disagreement(a, b, measured, links)
        factor = 1.0
        if _chi2(error, poses + motion) > _CHI2_99:
            # Understated: enlarged until the difference is one standard deviation.
            while _chi2(error, poses + factor * motion) > 1.0:
                factor *= 2.0
        factors |= dict.fromkeys(range(a, b), factor)
    return pieces, factors


def _propagated(known: dict[int, Pose], links: Sequence[UncertainPose]) -> list[Pose]:
    """Each instant's pose as the motion carries it from the nearest known one."""
    poses = []
    for i in range(len(links) + 1):
        nearest = min(known, key=lambda k: (abs(k - i), k))
        poses.append(chain(links, nearest, i).pose @ known[nearest])
    return poses


def _solve_unmeasured(
    instants: Sequence[WindowInstant],
    links: Sequence[UncertainPose],
    registration: RegistrationPreset,
    seed: int,
) -> list[WindowPose | None]:
    """Solve for instants of which none has a pose: first a group of them as one camera."""
    for first, last in _groups(instants, links, registration.max_error_px):
        middle = (first + last) // 2
        from_middle = [chain(links, middle, i).pose for i in range(first, last + 1)]
        views = [
            MatchedView(view.camera, view.cam_from_rig @ moved_on, view.pixels, view.points)
            for instant, moved_on in zip(instants[first : last + 1], from_middle, strict=True)
            for view in instant.views
        ]
        pose = estimate_generalized_pose(
            _thinned(views, seed), max_error_px=registration.max_error_px, seed=seed
        )
        if pose is None:
            continue
        start = _propagated({middle: pose.rig_from_world}, links)
        group = dict.fromkeys(range(first, last + 1), _MIN_GROUP_INLIERS)
        solved = _solve_together(instants, links, {}, start, group, registration)
        if solved is None:
            continue
        inliers = [np.concatenate(p.inliers) for p in solved[first : last + 1] if p.inliers]
        if _passes(np.concatenate(inliers), registration):
            return list(solved)
    return [None] * len(instants)


def _groups(
    instants: Sequence[WindowInstant], links: Sequence[UncertainPose], max_error_px: float
) -> Iterator[tuple[int, int]]:
    """First and last instants of overlapping groups within which drift stays small."""
    views = [view for instant in instants for view in instant.views if len(view)]
    if not views:
        return
    focal = float(np.median([view.camera.focal_length for view in views]))
    # How far the points are is not known before the pose; how far apart they are comes near.
    spread = [np.median(np.linalg.norm(v.points - np.median(v.points, 0), axis=1)) for v in views]
    depth = max(float(np.median(spread)), 1e-3)

    def drifts(middle: int, end: int) -> bool:
        variance = np.diag(chain(links, middle, end).covariance)
        shift = focal * math.sqrt(max(variance[:3]) + max(variance[3:]) / depth**2)
        return shift > _DRIFT_SHARE * max_error_px

    first = 0
    while True:
        last = first
        while last + 1 < len(instants):
            middle = (first + last + 1) // 2
            if drifts(middle, first) or drifts(middle, last + 1):
                break
            last += 1
        yield first, last
        if last == len(instants) - 1:
            return
        first += max((last - first + 1) // 2, 1)


def _thinned(views: Sequence[MatchedView], seed: int) -> list[MatchedView]:
    """The views with so few of their correspondences that RANSAC is done in a moment."""
    count = sum(len(view) for view in views)
    if count <= _MAX_GROUP_CORRESPONDENCES:
        return list(views)
    rng = np.random.default_rng(seed)
    share = _MAX_GROUP_CORRESPONDENCES / count
    return [_selected(view, rng.random(len(view)) < share) for view in views]


def _solve_together(
    instants: Sequence[WindowInstant],
    links: Sequence[UncertainPose],
    measured: dict[int, UncertainPose],
    start: Sequence[Pose],
    fewest: dict[int, int],
    registration: RegistrationPreset,
) -> list[WindowPose] | None:
    """Solve for linked instants from close poses, choosing again and again whose pixels count.

    Args:
        instants: N.
        links: N - 1.
        measured: poses that some have, relative to which the others are found.
        start: N poses.
        fewest: inliers that an instant needs to take part with its pixels, where that is not
            ``_MIN_OWN_INLIERS``.
        registration: the gate.

    Returns:
        None when all that takes part leaves the poses undetermined.
    """
    poses = list(start)
    scale = 1.0
    covariances: Sequence[NDArray[np.float64]] | None = None
    before: list[NDArray[np.bool_]] = []
    for _ in range(_MAX_ROUNDS):
        inliers = [_inliers(i.views, p, registration) for i, p in zip(instants, poses, strict=True)]
        seen = {
            i: tuple(
                _selected(v, k) for v, k in zip(instant.views, inliers[i], strict=True) if k.any()
            )
            for i, instant in enumerate(instants)
            if i not in measured
            and _supports(inliers[i], fewest.get(i, _MIN_OWN_INLIERS), registration)
        }
        known = Chain(links, measured, seen)
        old_scale = scale
        scale = error_scale(known, poses, covariances, _LOSS_SCALE_PX, old_scale)
        now = [mask for i in seen for mask in inliers[i]]
        same = len(now) == len(before) and all(map(np.array_equal, now, before))
        if same and covariances is not None and abs(scale / old_scale - 1.0) < _SCALE_SETTLED:
            break
        before = now
        solved = solve_chain(known, poses, _LOSS_SCALE_PX, scale)
        if solved is None:
            return None
        poses, covariances = solved
    if covariances is None:
        return None
    found = []
    for instant, pose, covariance in zip(instants, poses, covariances, strict=True):
        masks = _inliers(instant.views, pose, registration)
        enough = max(registration.min_inliers, _MIN_OWN_INLIERS)
        found.append(
            WindowPose(
                pose,
                UncertainPose(pose, covariance).additive(),
                masks,
                measured=_supports(masks, enough, registration),
            )
        )
    return found


def _inliers(
    views: Sequence[MatchedView], rig_from_world: Pose, registration: RegistrationPreset
) -> tuple[NDArray[np.bool_], ...]:
    masks = []
    for view in views:
        in_cam = view.cam_from_rig.apply(rig_from_world.apply(view.points))
        errors = np.linalg.norm(project(view.camera, in_cam) - view.pixels, axis=1)
        masks.append(errors <= registration.max_error_px)  # False for NaN: behind the camera
    return tuple(masks)


def _selected(view: MatchedView, which: NDArray[np.bool_]) -> MatchedView:
    return MatchedView(view.camera, view.cam_from_rig, view.pixels[which], view.points[which])


def _supports(
    masks: Sequence[NDArray[np.bool_]], fewest: int, registration: RegistrationPreset
) -> bool:
    """Whether an instant's inliers are at least ``fewest``, and the share that the gate demands."""
    inliers, count = sum(int(m.sum()) for m in masks), sum(len(m) for m in masks)
    return inliers >= max(fewest, registration.min_inlier_ratio * count)


def _passes(inliers: NDArray[np.bool_], registration: RegistrationPreset) -> bool:
    return _supports([inliers], registration.min_inliers, registration)
