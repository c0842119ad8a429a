"""Progress of a long command: bars on a terminal, a line per stage in a log."""

from __future__ import annotations

import time
from types import TracebackType

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)


class StageProgress:
    """Shows how far each stage is. Call it with the stage, how much is done, and how much is.

    Args:
        console: where to.
        if_stopped: what Ctrl-C leaves, for the person who pressed it.
    """

    def __init__(
        self, console: Console, if_stopped: str = "the same command resumes where it was"
    ) -> None:
        self._console = console
        self._if_stopped = if_stopped
        self._tasks: dict[str, TaskID] = {}
        self._started: dict[str, float] = {}
        self._bars = Progress(
            TextColumn("{task.description:18}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=console,
            disable=not console.is_terminal,
        )

    def __enter__(self) -> StageProgress:
        self._bars.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._bars.stop()
        if kind is KeyboardInterrupt:
            self._console.print(f"stopped; {self._if_stopped}")

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Tell that ``done`` of ``total`` items of a stage are finished."""
        if stage not in self._tasks:
            self._tasks[stage] = self._bars.add_task(stage, total=total)
            self._started[stage] = time.monotonic()
        self._bars.update(self._tasks[stage], completed=done, total=total)
        if done == total and not self._console.is_terminal:
            seconds = time.monotonic() - self._started[stage]
            self._console.print(f"{stage}: {done}/{total} in {seconds:.1f} s", highlight=False)
