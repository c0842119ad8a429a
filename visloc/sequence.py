"""A sequence of instants, answered in order as soon as each answer is final.

An instant that its own images do not localize waits for its neighbours: with relative motion
they are solved together (visloc.pose.window), without it the gap is interpolated
(visloc.trajectory). Both look at most ``max_gap_s`` ahead and back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from visloc.constraints import Constraints, MapGeometry
from visloc.errors import InvalidInput
from visloc.geometry import Pose, rotation_angle
from visloc.pose.covariance import with_origin
from visloc.pose.motion import RelativeMotion, default_motion_covariance
from visloc.pose.window import WindowInstant, WindowPose, solve_window
from visloc.priors import Priors
from visloc.solving import (
    SeenImage,
    Solved,
    image_answers,
    registration_for,
    rig_pose,
    solve_instant,
)
from visloc.timing import timed
from visloc.trajectory import (
    PoseSource,
    TimeUnit,
    TracedPose,
    center_covariance,
    covariance_from_center,
    fill_sequence,
)
from visloc.types import InstantAnswer, LocalizeOptions, Reason, Refusal

# At most so many instants wait, and as many answered ones are remembered, however long the gap
# may be: what is further away in a fast sequence adds little and costs time.
MAX_WAITING = 30
MAX_GAP_S = 60.0
# Standard deviation, as a share of the way, of motion that no measured pose can contradict.
_UNCHECKED_SHARE = 0.05
_CONTRADICTED = Refusal(
    "gate",
    Reason.CONTRADICTS_MOTION,
    "the pose of its own images contradicts those of its neighbours and the motion between",
)


@dataclass(frozen=True, slots=True, eq=False)
class Odometry:
    """Where a tracker has the rig, in a world of its own.

    Attributes:
        rig_from_odometry: the pose, metres.
        covariance: (6, 6) of ``rig_from_previous_rig``, the motion since the instant before, for
            R <- Exp(w) R and t <- t + dt; None when unknown.
    """

    rig_from_odometry: Pose
    covariance: NDArray[np.float64] | None


@dataclass(frozen=True, slots=True, eq=False)
class SeenInstant:
    """An instant, its images looked at.

    Attributes:
        timestamp: greater than that of the instant before.
        images: each of another camera of the rig; there may be none.
        odometry: None when there is none.
        priors: what is known of the rig.
    """

    timestamp: int
    images: tuple[SeenImage, ...]
    odometry: Odometry | None
    priors: Priors


class _Entry(NamedTuple):
    seen: SeenInstant
    solved: Solved  # on its own
    time_s: float


class SequenceSolver:
    """Takes instants one by one and gives back answers in order, each once it is final.

    Args:
        geometry: of the map.
        metric: whether one unit of the map's world is a metre.
        options: those that the images are looked at with.
        time_unit: of the timestamps.
        max_gap_s: longest time between measured instants across which gaps are filled; 0: none.

    Raises:
        InvalidInput: ``sequence.max_gap``.
    """

    def __init__(
        self,
        geometry: MapGeometry,
        *,
        metric: bool,
        options: LocalizeOptions,
        time_unit: TimeUnit,
        max_gap_s: float,
    ) -> None:
        check_max_gap(max_gap_s)
        self._geometry = geometry
        self._metric = metric
        self._options = options
        self._time_unit = time_unit
        self._max_gap_s = max_gap_s
        self._first_timestamp: int | None = None
        self._entries: list[_Entry] = []  # answered ones that still help, then those that wait
        self._num_answered = 0

    @property
    def measured(self) -> int:
        """Inliers of the newest instant if its own images localize it, else 0."""
        newest = self._entries[-1].solved.pose if self._entries else None
        return 0 if newest is None else newest.num_inliers

    def add(self, seen: SeenInstant) -> list[InstantAnswer]:
        """Take one more instant; return the answers that are final now.

        Raises:
            InvalidInput: ``sequence.odometry`` for a map that is not metric; ``priors.*`` that
                mean nothing in the map.
        """
        if seen.odometry is not None and not self._metric:
            raise InvalidInput(
                "sequence.odometry",
                "odometry is in metres, and this map's world has another unit",
                field="odometry",
                expected="a metric map, or a sequence without odometry",
            )
        if self._first_timestamp is None:
            self._first_timestamp = seen.timestamp
        time_s = (seen.timestamp - self._first_timestamp) * self._time_unit.seconds
        solved = solve_instant(
            seen.images, self._geometry, self._options, seen.priors, seen.timestamp
        )
        self._entries.append(_Entry(seen, solved, time_s))
        return self._answer(ended=False)

    def finish(self) -> list[InstantAnswer]:
        """Return the answers that waited for instants which will not come."""
        return self._answer(ended=True)

    def _answer(self, *, ended: bool) -> list[InstantAnswer]:
        stop = self._num_answered
        while stop < len(self._entries) and (ended or self._is_final(stop)):
            stop += 1
        if stop == self._num_answered:
            return []
        answers = self._answers(range(self._num_answered, stop))
        oldest_s = self._entries[min(stop, len(self._entries) - 1)].time_s - self._max_gap_s
        first = max(0, stop - MAX_WAITING)
        while first < stop and self._entries[first].time_s < oldest_s:
            first += 1
        del self._entries[:first]
        self._num_answered = stop - first
        return answers

    def _is_final(self, index: int) -> bool:
        """Whether nothing that may still come can change the answer to an instant that waits."""
        entry, newest = self._entries[index], self._entries[-1]
        if (
            newest.time_s - entry.time_s >= self._max_gap_s
            or len(self._entries) - index > MAX_WAITING
        ):
            return True
        if entry.seen.odometry is not None:
            return False
        return any(later.solved.pose is not None for later in self._entries[index:])

    def _answers(self, indices: range) -> list[InstantAnswer]:
        seconds: dict[str, float] = {}
        with timed(seconds, "sequence"):
            motions = self._motions()
            answers = [entry.solved.answer for entry in self._entries]
            linked = [
                any(motion is not None for motion in motions[max(0, i - 1) : i + 1])
                for i in range(len(self._entries))
            ]
            if any(linked):
                answers = self._solved_jointly(motions, linked)
            answers = self._filled(answers, linked)
        share = seconds["sequence"] / len(indices)
        return [
            replace(answers[i], seconds={**answers[i].seconds, "sequence": share}) for i in indices
        ]

    def _motions(self) -> list[RelativeMotion | None]:
        """Motion from each instant to the next; None where it is unknown or the gap too long."""
        motions: list[RelativeMotion | None] = []
        for before, after in pairwise(self._entries):
            a, b = before.seen.odometry, after.seen.odometry
            if a is None or b is None or after.time_s - before.time_s > self._max_gap_s:
                motions.append(None)
                continue
            motion = b.rig_from_odometry @ a.rig_from_odometry.inverse()
            covariance = default_motion_covariance(motion) if b.covariance is None else b.covariance
            motions.append(RelativeMotion(motion, covariance))
        return motions

    def _solved_jointly(
        self, motions: Sequence[RelativeMotion | None], linked: Sequence[bool]
    ) -> list[InstantAnswer]:
        """Solve all instants with their relative motion; those without keep their own answer."""
        cameras = [view.camera for entry in self._entries for view in entry.solved.views]
        registration = (
            registration_for(self._options, cameras) if cameras else self._options.registration
        )
        found = solve_window(
            [WindowInstant(entry.solved.views, entry.solved.pose) for entry in self._entries],
            motions,
            registration=registration,
            seed=self._options.seed,
        )
        supported = [i for i, pose in enumerate(found) if pose is not None and pose.supported]
        answers = []
        for i, (entry, pose) in enumerate(zip(self._entries, found, strict=True)):
            alone = entry.solved.answer
            if linked[i] and alone.pose is not None and (pose is None or not pose.measured):
                alone = replace(alone, pose=None, refusal=_CONTRADICTED)
            nearest = min(supported, key=lambda j: self._seconds_between(i, j), default=i)
            if (
                not linked[i]
                or pose is None
                or not supported
                or self._seconds_between(i, nearest) > self._max_gap_s
            ):
                answers.append(alone)
                continue
            covariance = pose.covariance
            if not supported[0] <= i <= supported[-1]:
                covariance = _with_unchecked_motion(pose, found[nearest])
            source = PoseSource.ESTIMATED if pose.measured else PoseSource.MOTION
            answers.append(
                self._with_pose(
                    replace(alone, images=image_answers(entry.seen.images, pose.inliers)),
                    TracedPose(pose.rig_from_world, covariance, source),
                    entry.seen.priors,
                )
            )
        return answers

    def _seconds_between(self, i: int, j: int) -> float:
        return abs(self._entries[j].time_s - self._entries[i].time_s)

    def _filled(
        self, answers: Sequence[InstantAnswer], linked: Sequence[bool]
    ) -> list[InstantAnswer]:
        """Fill instants without a pose, of which no motion is known, from those around them."""
        poses: list[TracedPose | None] = [
            None
            if answer.pose is None or answer.pose.source is not PoseSource.ESTIMATED
            else self._traced(answer)
            for answer in answers
        ]
        times_s = [entry.time_s for entry in self._entries]
        filled = fill_sequence(times_s, poses, self._max_gap_s)
        return [
            answer
            if answer.pose is not None or is_linked or pose is None
            else self._with_pose(answer, pose, entry.seen.priors)
            for answer, pose, is_linked, entry in zip(
                answers, filled, linked, self._entries, strict=True
            )
        ]

    def _traced(self, answer: InstantAnswer) -> TracedPose:
        """The pose of an answer, back in the map's own coordinates."""
        assert answer.pose is not None  # the caller has looked
        pose, covariance = with_origin(
            answer.pose.rig_from_world, answer.pose.covariance, -self._geometry.origin
        )
        return TracedPose(pose, covariance, answer.pose.source, answer.num_inliers)

    def _with_pose(self, answer: InstantAnswer, found: TracedPose, priors: Priors) -> InstantAnswer:
        """Give an answer a pose, unless it contradicts the priors."""
        constraints = Constraints(self._geometry, priors)
        contradiction = constraints.contradiction(found.pose, found.covariance)
        if contradiction is not None:
            refusal = answer.refusal or Refusal(
                "gate",
                Reason.CONTRADICTS_PRIOR,
                f"the best pose contradicts what is known: {contradiction}",
            )
            return replace(answer, pose=None, refusal=refusal)
        pose = rig_pose(found.pose, found.covariance, self._geometry, found.source)
        measured = found.source is PoseSource.ESTIMATED
        return replace(answer, pose=pose, refusal=None if measured else answer.refusal)


def check_max_gap(max_gap_s: float) -> None:
    """Refuse a gap that cannot be filled.

    Raises:
        InvalidInput: ``sequence.max_gap``.
    """
    if not 0 <= max_gap_s <= MAX_GAP_S:  # NaN fails too
        raise InvalidInput(
            "sequence.max_gap",
            "not usable",
            field="max_gap_s",
            expected=f"0 to {MAX_GAP_S:g} seconds",
            got=max_gap_s,
        )


def _with_unchecked_motion(pose: WindowPose, nearest: WindowPose | None) -> NDArray[np.float64]:
    """The covariance of a pose beyond all supported ones, where nothing can contradict motion.

    An error of its scale adds up along the way and is in no covariance that a tracker states.
    """
    assert nearest is not None  # it is supported
    here, there = pose.rig_from_world, nearest.rig_from_world
    distance = float(np.linalg.norm(here.center - there.center))
    angle = rotation_angle(here.rotation @ there.rotation.T)
    stds = [_UNCHECKED_SHARE * angle] * 3 + [_UNCHECKED_SHARE * distance] * 3
    covariance = center_covariance(here, pose.covariance) + np.diag(np.square(stds))
    return covariance_from_center(here, covariance)
