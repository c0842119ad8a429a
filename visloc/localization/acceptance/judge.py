"""Choose one answer among several searched places: maps, or tiles of a set.

Many inliers do not rule out that another place explains the photo as well. So one more inlier does
not decide: every place with at least half as many must agree.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from visloc.geometry import Similarity, rotation_angle
from visloc.localization.acceptance.preference import preference
from visloc.options import LocalizeOptions
from visloc.pose.motion import largest_std, moved_pose, position_covariance
from visloc.types import Candidate, InstantAnswer, Reason, Refusal, RigPose

# As shares of the most inliers. All answers above the first share must agree, or the result is
# ambiguous. Among the answers above the second share, the most certain wins.
_RIVAL_SHARE, _SIMILAR_SHARE = 0.5, 0.8
# A place with fewer is a rival too, unless the keypoints speak for the other place by this many
# standard deviations (``visloc.localization.acceptance.preference``). More than within a map: maps
# differ in how well they were made, and neighbouring keypoints err together.
SURE_OF_MAPS = 5.0
# Two answers agree when they differ by less than three standard deviations plus the slack of the
# tie between their places: a tenth of how far their photos see, and five degrees.
STDS = 3.0
TIE_REACH_SHARE, TIE_ANGLE = 0.1, math.radians(5.0)


@dataclass(frozen=True, slots=True, eq=False)
class PlaceAnswer:
    """The answer of one place.

    Attributes:
        map: ``id@version`` of the map, or of the set of maps, in whose frame the answer is.
        tile: of a set, ``id@version`` of the map in it; None otherwise.
    """

    map: str
    answer: InstantAnswer
    tile: str | None = None

    @property
    def ref(self) -> str:
        """``id@version`` of the map that was searched."""
        return self.tile or self.map


@dataclass(frozen=True, slots=True, eq=False)
class Tie:
    """The transform between the frames of two places.

    Attributes:
        a_from_b: from the frame of the second to that of the first.
        slack: largest error of that transform, in the unit of the first.
    """

    a_from_b: Similarity
    slack: float


# Returns the tie of two places, or None if the transform is unknown.
Ties = Callable[[int, int], Tie | None]


def judge(places: Sequence[PlaceAnswer], ties: Ties) -> int | Refusal:
    """Choose the answer among those of several places.

    The answer with the most inliers wins, or one with similarly many that is more certain. A place
    is a rival when it explains the photo at least half as well as the best, or when the keypoints
    do not surely speak against it. The photo is refused if the poses of two rivals differ, or
    cannot be compared because no tie is known: guessing could put the device into the wrong
    building. All pairs are compared, since an uncertain answer agrees with places that contradict
    each other.

    Args:
        places: at least one. An answer that a set refused as ambiguous counts as explaining the
            photo. So does one that was refused for its camera, with more inliers than any pose: a
            wrong camera in the right place does not make another place right.
        ties: between their frames.

    Returns:
        The row of the chosen answer, or a refusal, ``ambiguous``. If no place gave a pose, the row
        of the answer that came closest to one.
    """
    answers = [place.answer for place in places]
    explains = [i for i, answer in enumerate(answers) if _explains(answer)]
    closest = max(
        range(len(answers)), key=lambda i: (answers[i].num_inliers, answers[i].num_correspondences)
    )
    if not explains or _has_wrong_camera(answers[closest]):
        return closest
    best = max(explains, key=lambda i: answers[i].num_inliers)
    most = answers[best].num_inliers
    rivals = [i for i in explains if i == best or _is_rival(answers[i], answers[best])]
    for i in rivals:
        if measured_pose(answers[i]) is None:
            return i
    for i, j in itertools.combinations(rivals, 2):
        tie = ties(i, j)
        if tie is None or not poses_agree(answers[i], answers[j], tie):
            return _ambiguous(places[i], places[j], tied=tie is not None)
    similar = [i for i in rivals if answers[i].num_inliers >= _SIMILAR_SHARE * most]
    first = similar[0]

    def spread(i: int) -> float:
        """In the unit of the first, so that variances can be compared."""
        tie = None if i == first else ties(first, i)
        return _spread(answers[i]) * (1.0 if tie is None else tie.a_from_b.scale**2)

    return min(similar, key=spread)


def _is_rival(answer: InstantAnswer, best: InstantAnswer) -> bool:
    """Tell whether a place may be right although another one has more inliers."""
    if answer.num_inliers >= _RIVAL_SHARE * best.num_inliers:
        return True
    compared = _preference(best, answer)
    return compared is not None and compared < SURE_OF_MAPS


def _preference(first: InstantAnswer, second: InstantAnswer) -> float | None:
    """Say how surely the keypoints speak for the first answer; None when they do not compare."""
    if measured_pose(first) is None or measured_pose(second) is None:
        return None
    # The maps of a set find the same keypoints in a photo.
    if not len(first.scores) == len(second.scores) > 0:
        return None
    return preference(first.scores, second.scores)


def not_probable_enough(answer: InstantAnswer, options: LocalizeOptions) -> Refusal | None:
    """Refuse a pose that is less probable than the caller asks for, after rivals were compared.

    A pose without a probability, such as one from motion, is not judged.
    """
    probability = None if answer.pose is None else answer.pose.probability
    if probability is None or probability >= options.least_probability:
        return None
    return Refusal(
        "gate",
        Reason.UNLIKELY_POSE,
        f"the best pose is right with a probability of {probability:.2f}, but min_probability asks "
        f"for {options.least_probability:g}",
    )


def measured_pose(answer: InstantAnswer) -> RigPose | None:
    """Return the pose that an answer's own images measured."""
    return answer.pose if answer.refusal is None else None


def _explains(answer: InstantAnswer) -> bool:
    if answer.refusal is not None:
        return answer.refusal.reason is Reason.AMBIGUOUS
    return answer.pose is not None


def _has_wrong_camera(answer: InstantAnswer) -> bool:
    return answer.refusal is not None and answer.refusal.reason is Reason.CAMERA_CONTRADICTED


def _spread(answer: InstantAnswer) -> float:
    """Variance of the position, along all axes together."""
    pose = measured_pose(answer)
    if pose is None:
        return math.inf
    return float(position_covariance(pose.rig_from_world, pose.covariance).trace())


def poses_agree(a: InstantAnswer, b: InstantAnswer, tie: Tie) -> bool:
    """Whether two poses from two maps agree."""
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


def _ambiguous(a: PlaceAnswer, b: PlaceAnswer, *, tied: bool) -> Refusal:
    where = "at different places" if tied else "in frames without a known transform"
    advice = (
        "send priors that exclude one of them"
        if tied
        else "name one of them, put them into a set (mapping set), or anchor both (mapping anchor)"
    )
    return Refusal(
        "gate",
        Reason.AMBIGUOUS,
        f"{a.ref} and {b.ref} both explain the query, {where}, with {a.answer.num_inliers} and "
        f"{b.answer.num_inliers} inliers; {advice}",
        most_inliers_first([candidate(a, b.answer), candidate(b, a.answer)]),
    )


def candidate(place: PlaceAnswer, other: InstantAnswer | None = None) -> Candidate:
    """State the pose of one of two places, and what speaks for it.

    Args:
        other: the answer of the other place; None when their keypoints shall not be compared.
    """
    answer = place.answer
    assert answer.pose is not None  # the caller has looked
    return Candidate(
        answer.pose.rig_from_world,
        answer.num_inliers,
        place.map,
        place.tile,
        _best_image(answer),
        None if other is None else _preference(answer, other),
    )


def most_inliers_first(candidates: Sequence[Candidate]) -> tuple[Candidate, ...]:
    """Sort candidates for a refusal."""
    return tuple(sorted(candidates, key=lambda each: -each.num_inliers))


def _best_image(answer: InstantAnswer) -> str | None:
    """Return the mapping photo that looks most like the image with the most inliers."""
    seen = [i.evidence for i in answer.images if i.evidence is not None and i.evidence.retrieved]
    best = max(seen, key=lambda evidence: evidence.num_inliers, default=None)
    return None if best is None else best.retrieved[0].name
