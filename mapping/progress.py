"""Progress of a job: its stages, and how much of each is done."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

Progress = Callable[[str, int, int], None]
"""Called with the stage, how many of its items are done, and how many it has."""
ItemProgress = Callable[[int, int], None]
"""The progress of one stage: called with how many items are done, and how many there are."""


@contextmanager
def one_step(progress: Progress, stage: str) -> Iterator[None]:
    """Report a stage of a single item, which is the ``with`` block."""
    progress(stage, 0, 1)
    yield
    progress(stage, 1, 1)
