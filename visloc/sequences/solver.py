"""A sequence of instants, answered in order as soon as each answer is final.

An instant that its own images do not localize waits for its neighbours. With relative motion, they
are solved together (visloc.sequences.window); without it, the gap is interpolated
(visloc.sequences.filling). Both look at most ``max_gap_s`` ahead and back.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from visloc.errors import refuse
from visloc.geometry import center_covariance, covariance_from_center, rotation_angle
from visloc.localization.acceptance.corrections import NO_CAMERAS
from visloc.localization.acceptance.gates import contradicts_priors, registration_for
from visloc.localization.acceptance.judge import not_probable_enough
from visloc.localization.map_view.constraints import Frame, MapGeometry, PosePriors
from visloc.localization.solving import (
    SeenImage,
    Solved,
    rig_pose,
    solve_instant,
    with_inliers,
)
from visloc.options import LEAST_PROBABILITY, LocalizeOptions
from visloc.pose.motion import RelativeMotion, UncertainPose, link_from_motion, with_origin
from visloc.priors import Priors
from visloc.runtime.threads import timed
from visloc.sequences.filling import MAX_GAP_S, Odometry, TimeUnit, TracedPose, fill_sequence
from visloc.sequences.odometry_readings import (
    ALL_READINGS,
    AS_SENT,
    lead_elsewhere,
    link_between,
    narrowed,
)
from visloc.sequences.window import WindowInstant, WindowPose, solve_window
from visloc.types import InstantAnswer, PoseSource, Reason, Refusal

# At most this many instants wait, and as many answered ones are kept, whatever the gap: in a fast
# sequence, those further away add little and cost time.
MAX_WAITING = 30
# Standard deviation, as a share of the way, of motion that no measured pose can contradict.
_UNCHECKED_SHARE = 0.05
# Searching a window in which no instant has its own pose takes seconds. After a search in vain, the
# next one waits for this many new instants.
_BLIND_REST = 10
_NO_EVIDENCE = (
    Reason.CONTRADICTS_PRIOR,
    Reason.AMBIGUOUS,
    Reason.CAMERA_CONTRADICTED,
    Reason.UNLIKELY_POSE,
)
_CONTRADICTED = Refusal(
    "gate",
    Reason.CONTRADICTS_MOTION,
    "the pose from its own images contradicts the neighbours' poses and the motion between them",
)
_CONTRADICTS_PHOTOS = "contradicts the photos"


@dataclass(frozen=True, slots=True, eq=False)
class SeenInstant:
    """An instant whose images were matched.

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
    ticks: int  # of the time unit, since the first instant


class SequenceSolver:
    """Takes solved instants one by one and returns answers in order, each when it is final.

    Args:
        frame: of the poses, of one map or of many.
        metric: whether one unit of the map's world is a metre.
        options: those that the images are matched with.
        max_gap_s: longest time between measured instants across which gaps are filled; 0: none.
    """

    def __init__(
        self,
        frame: Frame,
        *,
        metric: bool,
        options: LocalizeOptions,
        time_unit: TimeUnit,
        max_gap_s: float,
    ) -> None:
        check_max_gap(max_gap_s)
        self._frame = frame
        self._metric = metric
        self._options = options
        self._tick_s = time_unit.seconds
        self._max_gap_s = max_gap_s
        # Whole ticks compare exactly; the difference of two times in seconds does not.
        self._max_gap = math.floor(max_gap_s / time_unit.seconds * (1.0 + 1e-9))
        self._first_timestamp: int | None = None
        self._entries: list[_Entry] = []  # answered ones that still help, then those that wait
        self._num_answered = 0
        self._readings = ALL_READINGS  # of the odometry, that fit the photos so far
        self.cameras = NO_CAMERAS  # what the instants so far say of theirs
        self._rest = 0  # instants to come before a window without any pose is searched again

    def take(self, seen: SeenInstant, solved: Solved) -> list[InstantAnswer]:
        """Take one more instant, solved in the frame; return the answers that are final now."""
        check_odometry(seen.odometry, metric=self._metric)
        refusal = not_probable_enough(solved.answer, self._options)
        if refusal is not None:
            solved = solved.refused(refusal)
        if solved.pose is not None:
            self.cameras = solved.cameras
        if self._first_timestamp is None:
            self._first_timestamp = seen.timestamp
        ticks = seen.timestamp - self._first_timestamp
        # What the images show is large, and was used.
        self._entries.append(_Entry(replace(seen, images=()), solved, ticks))
        self._rest = max(0, self._rest - 1)
        return self._answer(ended=False)

    def finish(self) -> list[InstantAnswer]:
        """Return the answers that are still waiting, when no more instants come."""
        self._rest = 0
        return self._answer(ended=True)

    def _answer(self, *, ended: bool) -> list[InstantAnswer]:
        stop = self._num_answered
        while stop < len(self._entries) and (ended or self._is_final(stop)):
            stop += 1
        if stop == self._num_answered:
            return []
        answers = self._answers(range(self._num_answered, stop))
        oldest = self._entries[min(stop, len(self._entries) - 1)].ticks - self._max_gap
        first = max(0, stop - MAX_WAITING)
        while first < stop and self._entries[first].ticks < oldest:
            first += 1
        del self._entries[:first]
        self._num_answered = stop - first
        return answers

    def _is_final(self, index: int) -> bool:
        """Whether no later instant can change the answer to an instant that waits."""
        entry, newest = self._entries[index], self._entries[-1]
        if newest.ticks - entry.ticks >= self._max_gap or len(self._entries) - index > MAX_WAITING:
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
            if a is None or b is None or after.ticks - before.ticks > self._max_gap:
                motions.append(None)
                continue
            given = RelativeMotion(*link_between(a, b))
            motions.append(given if link_from_motion(given) is not None else None)
        return motions

    def _solved_jointly(
        self, motions: Sequence[RelativeMotion | None], linked: Sequence[bool]
    ) -> list[InstantAnswer]:
        """Solve all instants with their relative motion; without motion, they keep their answer."""
        cameras = [view.camera for entry in self._entries for view in entry.solved.views]
        registration = (
            registration_for(self._options, cameras) if cameras else self._options.registration
        )
        blind = all(entry.solved.pose is None for entry in self._entries)
        found: list[WindowPose | None] = [None] * len(self._entries)
        if not blind or self._rest == 0:
            found = solve_window(
                [self._window_instant(entry.solved) for entry in self._entries],
                motions,
                registration=registration,
                seed=self._options.seed,
            )
            self._rest = _BLIND_REST if blind and not any(found) else 0
        cuts = [i for i, motion in enumerate(motions, 1) if motion is None]
        bounds = pairwise([0, *cuts, len(found)])
        run_of = [run for a, b in bounds for run in [range(a, b)] * (b - a)]
        for run in dict.fromkeys(run_of):
            self._narrow_readings(run, found)
        answers = []
        for i, (entry, pose) in enumerate(zip(self._entries, found, strict=True)):
            alone = entry.solved.answer
            if linked[i] and alone.pose is not None and (pose is None or not pose.measured):
                alone = replace(alone, pose=None, refusal=_CONTRADICTED)
            supported = [j for j in run_of[i] if (other := found[j]) and other.supported]
            if not linked[i] or not supported:
                answers.append(alone)
                continue
            nearest = min(supported, key=lambda j: self._ticks_between(i, j))
            if pose is None or self._ticks_between(i, nearest) > self._max_gap:
                answers.append(
                    self._unfilled(alone, "is too long" if pose else _CONTRADICTS_PHOTOS)
                )
                continue
            covariance = pose.covariance
            if not supported[0] <= i <= supported[-1]:
                around = supported[:2] if i < supported[0] else supported[:-3:-1]
                covariance = self._with_unchecked_motion(i, around, found)
            if not pose.supported:
                why = self._disbelief(run_of[i], nearest, i, pose)
                if why is not None:
                    answers.append(self._unfilled(alone, why))
                    continue
            source = PoseSource.ESTIMATED if pose.measured else PoseSource.MOTION
            answers.append(
                self._with_pose(
                    replace(alone, images=with_inliers(alone.images, pose.inliers)),
                    TracedPose(
                        pose.rig_from_world, covariance, source, entry.solved.errors.uncertainty
                    ),
                    entry.seen.priors,
                    pose.photo_covariance,
                )
            )
        return answers

    def _narrow_readings(self, run: range, found: Sequence[WindowPose | None]) -> None:
        measured = {
            j - run.start: UncertainPose.from_additive(pose.rig_from_world, pose.covariance)
            for j in run
            if (pose := found[j]) and pose.measured
        }
        self._readings = narrowed(self._readings, self._odometry(run), measured)

    def _odometry(self, run: range) -> list[Odometry]:
        entries = self._entries[run.start : run.stop]
        return [entry.seen.odometry for entry in entries if entry.seen.odometry is not None]

    def _disbelief(self, run: range, nearest: int, i: int, found: WindowPose) -> str | None:
        """Why the pose of instant i, carried by motion from the nearest supported, is not given."""
        if AS_SENT not in self._readings:
            return _CONTRADICTS_PHOTOS
        ends = nearest - run.start, i - run.start
        there = UncertainPose.from_additive(found.rig_from_world, found.covariance)
        if lead_elsewhere(self._readings, self._odometry(run), *ends, there.covariance):
            return "is not confirmed: the photos so far fit other conventions, too"
        away = self._frame.leads_out(there.pose.center)
        if away is not None:
            return f"leads out of the map, {away:.2f} from its nearest photo"
        return None

    def _unfilled(self, alone: InstantAnswer, why: str) -> InstantAnswer:
        """Add to the refusal why the neighbours and the motion gave this instant no pose."""
        if alone.pose is not None or alone.refusal is None:
            return alone
        message = f"{alone.refusal.message}; the neighbours have poses, but the motion {why}"
        if AS_SENT not in self._readings and len(self._readings) == 1:
            (name,) = self._readings
            message += f". The odometry looks like {name}: send rig_from_odometry in metres"
        return replace(alone, refusal=replace(alone.refusal, message=message))

    def _window_instant(self, solved: Solved) -> WindowInstant:
        refusal, errors = solved.answer.refusal, solved.errors
        if refusal is not None and refusal.reason in _NO_EVIDENCE:
            # Matches under wrong priors could pass together the gate that refused each alone.
            # Matches that another map explains as well are no evidence for this one. Pixels of a
            # wrong camera fit a wrong pose. A print or another floor is as unlikely in the next
            # photo.
            return WindowInstant((), None)
        if any(view.focal_unknown for view in solved.views):
            # A window takes cameras as they are: such pixels would fit a wrong pose.
            return WindowInstant((), solved.pose, errors)
        if solved.pose is None and self._options.least_probability > LEAST_PROBABILITY:
            # Nobody judges a pose that only the window measures, and the caller asks for more.
            return WindowInstant((), None)
        return WindowInstant(solved.views, solved.pose, errors)

    def _with_unchecked_motion(
        self, i: int, around: Sequence[int], found: Sequence[WindowPose | None]
    ) -> NDArray[np.float64]:
        """The covariance of a pose beyond all supported ones, where nothing contradicts motion.

        An error of its scale adds up along the way and is in no covariance that a tracker states;
        and a tracker that stops, or jumps, is told from a rig that does only by its inertia.

        Args:
            around: the nearest supported instant, and the next if there is one.
        """
        pose = found[i]
        assert pose is not None  # it hangs on the motion
        (distance, angle), *earlier = [_way(found[a], found[b]) for a, b in pairwise([i, *around])]
        stds = [_UNCHECKED_SHARE * angle, _UNCHECKED_SHARE * distance]
        for before in earlier:
            share = self._ticks_between(i, around[0]) / self._ticks_between(*around)
            stds[0] = math.hypot(stds[0], angle - share * before[1])
            stds[1] = math.hypot(stds[1], distance - share * before[0])
        added = np.diag(np.repeat(np.square(stds), 3))
        here = pose.rig_from_world
        return covariance_from_center(here, center_covariance(here, pose.covariance) + added)

    def _ticks_between(self, i: int, j: int) -> int:
        return abs(self._entries[j].ticks - self._entries[i].ticks)

    def _filled(
        self, answers: Sequence[InstantAnswer], linked: Sequence[bool]
    ) -> list[InstantAnswer]:
        """Fill instants that have no pose and no known motion from the instants around them."""
        poses: list[TracedPose | None] = [
            None
            if answer.pose is None or answer.pose.source is not PoseSource.ESTIMATED
            else self._traced(answer)
            for answer in answers
        ]
        times_s = [entry.ticks * self._tick_s for entry in self._entries]
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
            answer.pose.rig_from_world, answer.pose.covariance, -self._frame.origin
        )
        source, uncertainty = answer.pose.source, answer.pose.uncertainty
        return TracedPose(pose, covariance, source, uncertainty, answer.num_inliers)

    def _with_pose(
        self,
        answer: InstantAnswer,
        found: TracedPose,
        priors: Priors,
        photo_covariance: NDArray[np.float64] | None = None,
    ) -> InstantAnswer:
        """Give an answer a pose, unless it contradicts the priors.

        Args:
            photo_covariance: (6, 6), if the instant's own images measured the pose.
        """
        constraints = PosePriors(self._frame, priors)
        contradiction = contradicts_priors(constraints, found.pose, found.covariance)
        if contradiction is not None:
            return replace(answer, pose=None, refusal=answer.refusal or contradiction)
        pose = rig_pose(
            found.pose,
            found.covariance,
            self._frame.origin,
            found.source,
            found.uncertainty,
            photo_covariance,
        )
        measured = found.source is PoseSource.ESTIMATED
        if measured and answer.pose is not None:  # the motion agrees with what the images showed
            pose = replace(pose, probability=answer.pose.probability)
        return replace(answer, pose=pose, refusal=None if measured else answer.refusal)


class MapSequenceSolver(SequenceSolver):
    """Also solves the instants, each on its own in one map, whose geometry is the frame."""

    _frame: MapGeometry

    def add(self, seen: SeenInstant) -> list[InstantAnswer]:
        """Take one more instant; return the answers that are final now."""
        return self.take(seen, self.solve(seen))

    def solve(self, seen: SeenInstant) -> Solved:
        """Solve an instant on its own, before ``min_probability`` counts, so that maps compare."""
        check_odometry(seen.odometry, metric=self._metric)
        return solve_instant(
            seen.images,
            self._frame,
            self._options.before_rivals(),
            seen.priors,
            seen.timestamp,
            cameras=self.cameras,
        )


def check_max_gap(max_gap_s: float) -> None:
    """Refuse a gap that cannot be filled."""
    if not 0 <= max_gap_s <= MAX_GAP_S:  # NaN fails too
        raise refuse(
            "sequence.max_gap",
            field="max_gap_s",
            expected=f"0 to {MAX_GAP_S:g} seconds",
            got=max_gap_s,
        )


def check_odometry(odometry: Odometry | None, *, metric: bool) -> None:
    """Refuse odometry that cannot be compared with a map.

    Args:
        odometry: of an instant; None when there is none.
        metric: whether one unit of the map's world is a metre.
    """
    if odometry is not None and not metric:
        raise refuse("sequence.odometry", field="odometry")


def _way(a: WindowPose | None, b: WindowPose | None) -> tuple[float, float]:
    """Distance and angle (rad) between two poses."""
    assert a is not None  # both are supported, or hang on the motion
    assert b is not None
    here, there = a.rig_from_world, b.rig_from_world
    distance = float(np.linalg.norm(here.center - there.center))
    return distance, rotation_angle(here.rotation @ there.rotation.T)
