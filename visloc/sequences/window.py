"""The instants of a sequence solved together, with relative motion as the rig that holds them.

Instants whose own images do not do get the pose that measured neighbours and the motion between
them give; measured poses stay as they are. Where no instant was measured, the images of
many are one generalized camera, as Humenberger et al. 2020 have it for the cameras of a rig.

Motion is believed only as far as measured poses do not contradict it: between two that do, nothing
is filled, and both stay as they were measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visloc.geometry import Pose
from visloc.options import RegistrationPreset
from visloc.pose.generalized import GeneralizedPose, refine_generalized_pose
from visloc.pose.motion import (
    PHOTO_ONLY,
    MapErrors,
    RelativeMotion,
    UncertainPose,
    link_from_motion,
)
from visloc.pose.refinement import LOSS_SCALE_PX
from visloc.pose.reprojection import MatchedView, reprojection_errors
from visloc.sequences.agreement import agreeing_pieces
from visloc.sequences.group import carried, find_groups
from visloc.sequences.pose_graph import Chain, error_scale, solve_chain
from visloc.types import Uncertainty

# Fewer inliers under a pose that others gave are chance: blurred images have such, too.
_MIN_OWN_INLIERS = 8
# In a group that passed the gate together, three of the consensus are enough.
_MIN_GROUP_INLIERS = 3
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
    errors: MapErrors = PHOTO_ONLY


@dataclass(frozen=True, slots=True, eq=False)
class WindowPose:
    """The pose of one instant, from all that the window knows.

    Attributes:
        rig_from_world: in the frame of the views' points.
        covariance: (6, 6) of rotation (rad) then translation, for R <- Exp(w) R and t <- t + dt,
            with the errors of the map.
        inliers: per view, (n,) bool, reprojection error within the threshold.
        measured: the instant's own images measured it: they support it as the gate demands.
            Otherwise it rests on other instants and the motion.
        supported: its own images took part, be it with a few pixels. One that is not hangs on
            the motion alone.
        photo_covariance: (6, 6), what the instant's own images leave open; None when they did not
            measure the pose.
    """

    rig_from_world: Pose
    covariance: NDArray[np.float64]
    inliers: tuple[NDArray[np.bool_], ...]
    measured: bool
    supported: bool
    photo_covariance: NDArray[np.float64] | None = None


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
       Motion that agrees, but worse than its stated covariance lets expect, counts with a larger
       one (``visloc.sequences.agreement``).
    2. A part without measured poses is tried as one generalized camera, in groups small enough
       for the motion's drift.
    3. All poses of a part are solved together (``visloc.sequences.pose_graph``): measured ones with
       the photo's part of their covariance, motion with its own, and the pixels of instants that
       were not measured but agree with the pose that the others give them. The errors of the map,
       which all instants share, are added once at the end.

    A wrong motion that no measured pose contradicts, as beyond the last one, cannot be seen here
    (but see ``visloc.sequences.odometry_readings``): there, the covariance is as honest as that of
    the motion. A motion that claims to be exact and is off by less than the measured poses are
    unsure pulls them along by that much.

    Args:
        motions: N - 1, from instant i to i + 1; None where unknown.
        registration: the gate, and the largest reprojection error of an inlier.

    Returns:
        For each instant its pose, or None when nothing supports one.
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
    found: list[WindowPose | None] = [_alone(instant) for instant in instants]
    measured = {
        i: UncertainPose.from_additive(pose.rig_from_world, pose.covariance)
        for i, pose in enumerate(found)
        if pose is not None
    }
    if not measured:
        return _solve_unmeasured(instants, links, registration, seed)
    photo_parts = {
        i: UncertainPose.from_additive(pose.rig_from_world, pose.photo_covariance)
        for i, pose in enumerate(found)
        if pose is not None and pose.photo_covariance is not None
    }
    pieces, links = agreeing_pieces(measured, links)
    counted = {i for piece in pieces for i in piece.measured}
    for i in measured.keys() - counted:
        found[i] = None
    for piece in pieces:
        inside = range(piece.first, piece.last + 1)
        if len(inside) == 1:
            continue
        known = {i - piece.first: photo_parts[i] for i in piece.measured}
        between = links[piece.first : piece.last]
        start = _propagated({i: pose.pose for i, pose in known.items()}, between)
        some = instants[piece.first : piece.last + 1]
        solved = _solve_together(some, between, known, start, {}, registration)
        if solved is not None:
            for i, pose in zip(inside, solved, strict=True):
                if i not in counted:
                    found[i] = pose
    return found


def _alone(instant: WindowInstant) -> WindowPose | None:
    """The pose that an instant has on its own."""
    pose = instant.alone
    if pose is None or pose.covariance is None:
        return None
    return _measured(pose, pose.covariance, instant.errors)


def _measured(
    pose: GeneralizedPose, photo_covariance: NDArray[np.float64], errors: MapErrors
) -> WindowPose:
    """A pose that an instant's own images measured, with the errors of the map."""
    return WindowPose(
        pose.rig_from_world,
        errors.whole(pose.rig_from_world, photo_covariance, pose.of_camera),
        pose.inliers,
        measured=True,
        supported=True,
        photo_covariance=photo_covariance,
    )


def _propagated(known: dict[int, Pose], links: Sequence[UncertainPose]) -> list[Pose]:
    """Each instant's pose as the motion carries it from the nearest known one."""
    from_first = carried(links)
    poses = []
    for i, here in enumerate(from_first):
        nearest = min(known, key=lambda k: (abs(k - i), k))
        poses.append(here @ from_first[nearest].inverse() @ known[nearest])
    return poses


def _solve_unmeasured(
    instants: Sequence[WindowInstant],
    links: Sequence[UncertainPose],
    registration: RegistrationPreset,
    seed: int,
) -> list[WindowPose | None]:
    """Solve for instants of which none has a pose: first a group of them, then around it."""
    for group in find_groups([i.views for i in instants], links, registration, seed):
        start = _propagated({group.reference: group.rig_from_world}, links)
        members = range(group.first, group.last + 1)
        fewest = dict.fromkeys(members, _MIN_GROUP_INLIERS)
        solved = _solve_together(instants, links, {}, start, fewest, registration)
        if solved is not None:
            inliers = [mask for i in members for mask in solved[i].inliers]
            if _supports(inliers, registration.min_inliers, registration):
                return list(solved)
    return [None] * len(instants)


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
        instants: N, with N - 1 ``links`` and N poses to ``start`` from.
        measured: poses that some have, relative to which the others are found; with the photo's
            part of their covariance, as errors of the map are common to all.
        fewest: inliers that an instant needs to take part with its pixels, where that is not
            ``_MIN_OWN_INLIERS``.

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
            i: _selected(instant.views, inliers[i])
            for i, instant in enumerate(instants)
            if i not in measured
            and _supports(inliers[i], fewest.get(i, _MIN_OWN_INLIERS), registration)
        }
        known = Chain(links, measured, seen)
        old_scale = scale
        scale = error_scale(known, poses, covariances, LOSS_SCALE_PX, old_scale)
        now = [mask for i in seen for mask in inliers[i]]
        settled = covariances is not None and abs(scale / old_scale - 1.0) < _SCALE_SETTLED
        if settled and len(now) == len(before) and all(map(np.array_equal, now, before)):
            break
        before = now
        solved = solve_chain(known, poses, LOSS_SCALE_PX, scale)
        if solved is None:
            return None
        poses, covariances = solved
    if covariances is None:
        return None
    taking_part = {*known.measured, *known.seen}
    return [
        _measured_from(instant, pose, registration)
        or WindowPose(
            pose,
            _with_map_errors(i, UncertainPose(pose, covariance), instant.errors, known),
            _inliers(instant.views, pose, registration),
            measured=False,
            supported=i in taking_part,
        )
        for i, (instant, pose, covariance) in enumerate(
            zip(instants, poses, covariances, strict=True)
        )
    ]


def _selected(
    views: Sequence[MatchedView], inliers: Sequence[NDArray[np.bool_]]
) -> tuple[MatchedView, ...]:
    """Return the inliers of the views that have any."""
    return tuple(v.selected(k) for v, k in zip(views, inliers, strict=True) if k.any())


def _with_map_errors(
    i: int, found: UncertainPose, errors: MapErrors, known: Chain
) -> NDArray[np.float64]:
    """Add the errors of the map to a pose that others support.

    Instants share these errors, so their number does not make them smaller: they are those of the
    nearest measured pose, carried along. Where the pixels of many instants together measured the
    poses, they are those of one instant alone, which leaves as many times the variance open.

    Returns:
        The covariance (6, 6) for R <- Exp(w) R and t <- t + dt.
    """
    if errors.uncertainty is Uncertainty.PHOTO_ONLY:
        return found.additive()
    if not known.measured:
        alone = len(known.seen) * found.additive()
        return found.additive() + errors.part(found.pose, alone)
    nearest = known.measured[min(known.measured, key=lambda k: (abs(k - i), k))]
    of_map = errors.part(nearest.pose, nearest.additive())
    carried_here = UncertainPose(found.pose @ nearest.pose.inverse(), np.zeros((6, 6)))
    shared = carried_here @ UncertainPose.from_additive(nearest.pose, of_map)
    return UncertainPose(found.pose, found.covariance + shared.covariance).additive()


def _measured_from(
    instant: WindowInstant, start: Pose, registration: RegistrationPreset
) -> WindowPose | None:
    """The pose that an instant's own images give near ``start``, if they support it."""
    views = instant.views
    enough = max(registration.min_inliers, _MIN_OWN_INLIERS)
    if not _supports(_inliers(views, start, registration), enough, registration):
        return None
    own = refine_generalized_pose(views, start, max_error_px=registration.max_error_px)
    if own is None or own.covariance is None or not _supports(own.inliers, enough, registration):
        return None
    return _measured(own, own.covariance, instant.errors)


def _inliers(
    views: Sequence[MatchedView], rig_from_world: Pose, registration: RegistrationPreset
) -> tuple[NDArray[np.bool_], ...]:
    # False for NaN: behind the camera.
    return tuple(
        np.asarray(reprojection_errors(view, rig_from_world) <= registration.max_error_px)
        for view in views
    )


def _supports(
    masks: Sequence[NDArray[np.bool_]], fewest: int, registration: RegistrationPreset
) -> bool:
    """Whether an instant's inliers are at least ``fewest``, and the share that the gate demands."""
    inliers, count = sum(int(m.sum()) for m in masks), sum(len(m) for m in masks)
    return inliers >= max(fewest, registration.min_inlier_ratio * count)
