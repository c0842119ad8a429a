"""One answer of several places that were searched: maps, or tiles of a set.

Inliers say how well a place explains a photo, not that no other place explains it as well. So no
answer is taken for having one inlier more: another place that explains half as much must agree.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from visloc.geometry import Similarity, rotation_angle
from visloc.pose.centre import largest_std, moved_pose, position_covariance
from visloc.types import InstantAnswer, Reason, Refusal, RigPose

# Of the most inliers: answers of this share must agree with each other, or the answer is
# ambiguous; of those of this share, the most certain counts.
_RIVAL_SHARE, _SIMILAR_SHARE = 0.5, 0.8
# Answers agree that are no further apart than what both leave open (three standard deviations),
# and how well their places are tied to each other: a tenth of how far their photos see, five
# degrees.
STDS = 3.0
TIE_REACH_SHARE, TIE_ANGLE = 0.1, math.radians(5.0)


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """What one place answered.

    Attributes:
        ref: the map, ``id@version``.
        answer: in a frame of the place's own.
    """

    ref: str
    answer: InstantAnswer


@dataclass(frozen=True, slots=True, eq=False)
class Tie:
    """How the frames of two candidates lie to each other.

    Attributes:
        a_from_b: from the frame of the second to that of the first.
        slack: how far off that may be, in the unit of the first.
    """

    a_from_b: Similarity
    slack: float


# Given two candidates, the tie of their frames; None where nothing ties them.
Ties = Callable[[int, int], Tie | None]


def judge(candidates: Sequence[Candidate], ties: Ties) -> int | Refusal:
    """Choose the answer among those of several places.

    Of answers with a pose, the one with the most inliers counts, or one that has similarly many
    and is more certain. The photo is refused where two places explain it at least half as well as
    the best does, and their poses differ, or cannot be compared because nothing ties the places to
    each other: guessing could put the device into the wrong building. All pairs are compared, since
    an uncertain answer agrees with places that contradict each other.

    Args:
        candidates: at least one. One that was refused as ambiguous itself (by a set) counts
            among the places that explain the photo.
        ties: between their frames.

    Returns:
        The row of the answer; when no place gave a pose, of the one that came furthest. Or a
        refusal, ``ambiguous``.
    """
    answers = [candidate.answer for candidate in candidates]
    explains = [i for i, answer in enumerate(answers) if _explains(answer)]
    if not explains:
        return max(
            range(len(answers)),
            key=lambda i: (answers[i].num_inliers, answers[i].num_correspondences),
        )
    most = max(answers[i].num_inliers for i in explains)
    rivals = [i for i in explains if answers[i].num_inliers >= _RIVAL_SHARE * most]
    for i in rivals:
        if measured_pose(answers[i]) is None:
            return i
    for i, j in itertools.combinations(rivals, 2):
        tie = ties(i, j)
        if tie is None or not _agree(answers[i], answers[j], tie):
            return _ambiguous(candidates[i], candidates[j], tied=tie is not None)
    similar = [i for i in rivals if answers[i].num_inliers >= _SIMILAR_SHARE * most]
    first = similar[0]

    def spread(i: int) -> float:
        """In the unit of the first, so that variances can be compared."""
        tie = None if i == first else ties(first, i)
        return _spread(answers[i]) * (1.0 if tie is None else tie.a_from_b.scale**2)

    return min(similar, key=spread)


def measured_pose(answer: InstantAnswer) -> RigPose | None:
    """Return the pose that an answer's own images measured."""
    return answer.pose if answer.refusal is None else None


def _explains(answer: InstantAnswer) -> bool:
    if answer.refusal is not None:
        return answer.refusal.reason is Reason.AMBIGUOUS
    return answer.pose is not None


def _spread(answer: InstantAnswer) -> float:
    """Variance of the position, along all axes together."""
    pose = measured_pose(answer)
    if pose is None:
        return math.inf
    return float(position_covariance(pose.rig_from_world, pose.covariance).trace())


def _agree(a: InstantAnswer, b: InstantAnswer, tie: Tie) -> bool:
    """Whether two poses are those of one place, seen from two maps."""
    known_a, known_b = measured_pose(a), measured_pose(b)
    assert known_a is not None  # the caller has looked
    assert known_b is not None
    pose_a, covariance_a = known_a.rig_from_world, known_a.covariance
    pose_b, covariance_b = moved_pose(known_b.rig_from_world, known_b.covariance, tie.a_from_b)
    away = float(np.linalg.norm(pose_a.center - pose_b.center))
    turned = rotation_angle(pose_a.rotation @ pose_b.rotation.T)
    turn_std = math.sqrt(covariance_a[:3, :3].trace() + covariance_b[:3, :3].trace())
    move_std = math.hypot(largest_std(pose_a, covariance_a), largest_std(pose_b, covariance_b))
    return away <= tie.slack + STDS * move_std and turned <= TIE_ANGLE + STDS * turn_std


def _ambiguous(a: Candidate, b: Candidate, *, tied: bool) -> Refusal:
    where = "at different places" if tied else "and nothing says how they lie to each other"
    advice = (
        "say where it is (priors)"
        if tied
        else "name one of them, put them into a set (mapping set), or anchor both (mapping anchor)"
    )
    return Refusal(
        "gate",
        Reason.AMBIGUOUS,
        f"{a.ref} and {b.ref} both explain it, {where}, with {a.answer.num_inliers} and "
        f"{b.answer.num_inliers} inliers; {advice}",
    )
