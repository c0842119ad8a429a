"""The cost of each stage of a build: time, work of all processes, and bytes written."""

from __future__ import annotations

import resource
import time
from dataclasses import dataclass
from typing import Protocol

from mapping.progress import Progress

_written_bytes = 0


@dataclass(frozen=True, slots=True)
class Spent:
    """Resources that processes have used.

    Attributes:
        cpu_s: CPU seconds of all threads.
        written_bytes: written to files.
        peak_bytes: most memory that one of the processes ever held.
    """

    cpu_s: float = 0.0
    written_bytes: int = 0
    peak_bytes: int = 0

    def __add__(self, other: Spent) -> Spent:
        written_bytes = self.written_bytes + other.written_bytes
        peak_bytes = max(self.peak_bytes, other.peak_bytes)
        return Spent(self.cpu_s + other.cpu_s, written_bytes, peak_bytes)

    def __sub__(self, other: Spent) -> Spent:
        written_bytes = self.written_bytes - other.written_bytes
        return Spent(self.cpu_s - other.cpu_s, written_bytes, self.peak_bytes)


def wrote(num_bytes: int) -> None:
    """Count bytes that this process has written."""
    global _written_bytes
    _written_bytes += num_bytes


def spent_here() -> Spent:
    """Return the resources that this process has used so far."""
    peak_bytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return Spent(time.process_time(), _written_bytes, peak_bytes)


@dataclass(frozen=True, slots=True)
class StageCost:
    """The cost of one stage.

    Attributes:
        items: how many it had; None for several stages together.
        wall_s: seconds from its start to its end.
    """

    stage: str
    items: int | None
    wall_s: float
    spent: Spent


class _Workers(Protocol):
    @property
    def spent(self) -> Spent:
        """Used by other processes so far."""
        ...


class Costs:
    """Measures the stages of a build, which follow one another."""

    def __init__(self) -> None:
        self._workers: _Workers | None = None
        self._begun: dict[str, _Moment] = {}
        self._stages: dict[str, StageCost] = {}
        self._start = self._now()

    def measured(self, progress: Progress, workers: _Workers) -> Progress:
        """Return a progress that measures stages and passes calls on to ``progress``."""
        self._workers = workers

        def note(stage: str, done: int, total: int) -> None:
            begin = self._begun.setdefault(stage, self._now())
            if done == total:
                del self._begun[stage]
                cost = _cost(stage, total, begin, self._now())
                if (before := self._stages.get(stage)) is not None:  # it was done once more
                    wall_s, spent = before.wall_s + cost.wall_s, before.spent + cost.spent
                    cost = StageCost(stage, total, wall_s, spent)
                self._stages[stage] = cost
            progress(stage, done, total)

        return note

    def table(self) -> list[StageCost]:
        """Return the finished stages, the time between them, and the whole so far."""
        stages = list(self._stages.values())
        whole = _cost("in all", None, self._start, self._now())
        between = StageCost(
            "between",
            None,
            whole.wall_s - sum(one.wall_s for one in stages),
            whole.spent - sum((one.spent for one in stages), Spent()),
        )
        return [*stages, between, whole]

    def _now(self) -> _Moment:
        elsewhere = Spent() if self._workers is None else self._workers.spent
        return _Moment(time.monotonic(), spent_here() + elsewhere)


@dataclass(frozen=True, slots=True)
class _Moment:
    clock_s: float
    spent: Spent


def _cost(stage: str, items: int | None, begin: _Moment, end: _Moment) -> StageCost:
    return StageCost(stage, items, end.clock_s - begin.clock_s, end.spent - begin.spent)
