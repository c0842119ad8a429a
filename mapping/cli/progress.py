"""Progress of a long command: bars on a terminal, lines in a log.

A log gets a line at the end of each stage, and every five seconds.
"""

from __future__ import annotations

import threading
import time
from types import TracebackType

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

# Time between two lines in a log.
_LINE_EVERY_S = 5.0


class StageProgress:
    """A ``mapping.progress.Progress`` that prints."""

    def __init__(
        self, console: Console, if_stopped: str = "the same command resumes where it was"
    ) -> None:
        self._console = console
        self._if_stopped = if_stopped
        self._tasks: dict[str, TaskID] = {}
        self._started: dict[str, float] = {}
        self._ended = threading.Event()
        self._lines = threading.Thread(target=self._print_lines, name="progress", daemon=True)
        self._bars = Progress(
            SpinnerColumn(),
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
        if not self._console.is_terminal:
            self._lines.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._ended.set()
        if self._lines.is_alive():
            self._lines.join()
        self._bars.stop()
        if kind is KeyboardInterrupt:
            self._console.print(f"stopped; {self._if_stopped}")

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Show that ``done`` of ``total`` items of a stage are finished."""
        if stage not in self._tasks:
            self._tasks[stage] = self._bars.add_task(stage, total=total)
            self._started[stage] = time.monotonic()
        elif done < total and self._bars.tasks[self._tasks[stage]].finished:
            self._bars.reset(self._tasks[stage])  # a stage that is done once more
            self._started[stage] = time.monotonic()
        self._bars.update(self._tasks[stage], completed=done, total=total)
        seconds = time.monotonic() - self._started[stage]
        # A single step that ends before its first line gets no line at all.
        is_told = total > 1 or seconds >= _LINE_EVERY_S
        if done == total and is_told and not self._console.is_terminal:
            self._console.print(f"{stage}: {done}/{total} in {seconds:.1f} s", highlight=False)

    def _print_lines(self) -> None:
        while not self._ended.wait(_LINE_EVERY_S):
            for task in self._bars.tasks:
                if task.finished:
                    continue
                left_s = task.time_remaining
                self._console.print(
                    f"{task.description}: {task.completed:.0f}/{task.total:.0f} after "
                    f"{task.elapsed:.0f} s" + (f", about {left_s:.0f} s left" if left_s else ""),
                    highlight=False,
                )
