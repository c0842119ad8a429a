"""A sequence that is being solved, in worker processes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from service.values import InstantJob, Localization, SequenceJob, check_order
from service.workers.instants import Target, check_images, check_options, check_priors
from service.workers.judging import settled
from visloc.errors import inside, refuse
from visloc.localization.acceptance.judge import candidate, most_inliers_first
from visloc.localization.solving import SeenImage, Solved
from visloc.priors import Priors
from visloc.sequences.filling import TimeUnit, guess_time_unit
from visloc.sequences.solver import MapSequenceSolver, SeenInstant, check_max_gap, check_odometry
from visloc.types import Candidate, InstantAnswer, Reason, Refusal


class SequenceRun:
    """Solves a sequence in each of its maps until one map is settled on.

    Attributes:
        targets: the maps that are still searched.
    """

    def __init__(
        self, start: SequenceJob, targets: Sequence[Target], max_images: int, max_instants: int
    ) -> None:
        check_max_gap(start.max_gap_s)
        check_options(targets, start.options)
        check_priors(targets, start.priors)
        self.targets = targets
        self._start = start
        self._max_images = max_images
        self._max_instants = max_instants
        self._last_checked: tuple[int, int] | None = None  # index, timestamp
        self._solvers: list[MapSequenceSolver] = []
        self._held: list[list[InstantAnswer]] = [[] for _ in targets]

    def check(self, index: int, instant: InstantJob) -> Priors:
        """Refuse an instant that cannot be solved, and return its priors.

        Instants are checked in order, which may begin again with the first.
        """
        check_number(index, self._max_instants)
        with inside(f"instants[{index}]"):
            before = self._last_checked
            if before is not None and before[0] < index:
                check_order(before[1], instant.timestamp)
            self._last_checked = index, instant.timestamp
            for target in self.targets:
                rig = None if self._start.rig is None else target.rig
                check_images(instant.images, rig, self._max_images, "images")
                check_odometry(instant.odometry, metric=_is_metric(target))
            if instant.priors is None:
                return self._start.priors
            check_priors(self.targets, instant.priors)
            return instant.priors

    def add(
        self, instant: InstantJob, images: Sequence[tuple[SeenImage, ...]], priors: Priors
    ) -> list[InstantAnswer]:
        """Solve an instant, given its images by target; return the answers that are final now."""
        if not self._solvers:
            unit = self._start.time_unit or guessed_unit(instant.timestamp)
            self._solvers = [self._solver(target, unit) for target in self.targets]
        assert self._last_checked is not None  # it was checked before
        with inside(f"instants[{self._last_checked[0]}]"):
            shown = [
                SeenInstant(instant.timestamp, seen, instant.odometry, priors) for seen in images
            ]
            solved = [solver.solve(seen) for solver, seen in zip(self._solvers, shown, strict=True)]
            settled, solved = self._judged(solved, priors)
            for solver, held, seen, one in zip(
                self._solvers, self._held, shown, solved, strict=True
            ):
                held += solver.take(seen, one)
        if settled is not None:
            self._keep(settled)
        return self._released() if len(self.targets) == 1 else []

    def finish(self) -> list[InstantAnswer]:
        """Return the answers that waited for further instants."""
        if not self._solvers:
            raise refuse("sequence.empty", field="instants")
        for held, solver in zip(self._held, self._solvers, strict=True):
            held += solver.finish()
        # Motion may place instants that no image localizes, but not in several maps.
        placed = [
            i for i, held in enumerate(self._held) if any(each.pose is not None for each in held)
        ]
        if len(self._held) > 1 and len(placed) > 1:
            instants = list(zip(*self._held, strict=True))
            undecided = [self._candidates(answers) for answers in instants]
            self._held = [
                [_unplaced(*each) for each in zip(held, undecided, strict=True)]
                for held in self._held
            ]
        self._keep(placed[0] if placed else 0)
        return self._released()

    def localization(self, answer: InstantAnswer) -> Localization:
        return self.targets[0].localization(answer, ypr=self._start.ypr)

    def _judged(self, solved: list[Solved], priors: Priors) -> tuple[int | None, list[Solved]]:
        """Return the map to settle on, if any, and the instant's solution in each map.

        An instant that ``settled`` refuses has a pose in none of them.
        """
        if len(self.targets) == 1:
            return None, solved
        found = [
            target.localization(one.answer, ypr=self._start.ypr)
            for target, one in zip(self.targets, solved, strict=True)
        ]
        best, refusal = settled(found, self._start.options, priors)
        if refusal is None:
            return best, solved
        return None, [one if one.pose is None else one.refused(refusal) for one in solved]

    def _candidates(self, answers: Sequence[InstantAnswer]) -> tuple[Candidate, ...]:
        """State the poses of an instant, given its answers by target, in two of the maps."""
        found = most_inliers_first(
            [
                candidate(target.localization(answer, ypr=False).place)
                for target, answer in zip(self.targets, answers, strict=True)
                if answer.pose is not None
            ]
        )
        return found[:2] if len(found) > 1 else ()

    def _keep(self, index: int) -> None:
        """Search only this map from now on."""
        self.targets = [self.targets[index]]
        self._solvers = [self._solvers[index]]
        self._held = [self._held[index]]

    def _released(self) -> list[InstantAnswer]:
        released, self._held[0] = self._held[0], []
        return released

    def _solver(self, target: Target, unit: TimeUnit) -> MapSequenceSolver:
        return MapSequenceSolver(
            target.localizer.geometry,
            metric=_is_metric(target),
            options=self._start.options,
            time_unit=unit,
            max_gap_s=self._start.max_gap_s,
        )


def _unplaced(answer: InstantAnswer, candidates: tuple[Candidate, ...]) -> InstantAnswer:
    """Remove a pose that another map contradicts."""
    if answer.pose is None:
        return answer
    refusal = answer.refusal or Refusal(
        "gate",
        Reason.AMBIGUOUS,
        "several of the maps explain the sequence; name one, or say where it is (priors)",
        candidates,
    )
    return replace(answer, pose=None, refusal=refusal)


def _is_metric(target: Target) -> bool:
    return target.localizer.map.manifest.world.metric


def check_number(index: int, max_instants: int) -> None:
    """Refuse the instants of a sequence that are too many."""
    if index >= max_instants:
        raise refuse(
            "sequence.too_many_instants", field="instants", expected=f"at most {max_instants}"
        )


def guessed_unit(timestamp: int) -> TimeUnit:
    """Tell the unit of a sequence's timestamps from the first of them."""
    unit = guess_time_unit([timestamp])
    if unit is None:
        raise refuse(
            "sequence.time_unit",
            "the size of the timestamps does not reveal their unit",
            field="time_unit",
            expected=TimeUnit,
        )
    return unit
