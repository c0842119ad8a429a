"""Progress of a job: its stages, and how much of each is done."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

Progress = Callable[[str, int, int], None]
"""Called with the stage, how many of its items are done, and how many it has."""
ItemProgress = Callable[[int, int], None]
"""The progress of one stage: called with how many items are done, and how many there are."""


def not_told(_done: int, _total: int) -> None:
    """Progress that nobody sees."""


def nothing_told(_stage: str, _done: int, _total: int) -> None:
    """Progress of all stages that nobody sees."""


def part_of(progress: ItemProgress, number: int, parts: int) -> ItemProgress:
    """Return the progress of one of several equal parts of a stage, counted from 0.

    The last part does not report the end of the stage, so that work after it can.
    """

    def tell(done: int, total: int) -> None:
        whole = parts * total
        progress(min(number * total + done, whole - 1), whole)

    return tell


@contextmanager
def one_step(progress: Progress, stage: str) -> Iterator[None]:
    """Report a stage of a single item, which is the ``with`` block."""
    progress(stage, 0, 1)
    yield
    progress(stage, 1, 1)
