"""Progress of a long command: bars on a terminal; in a log, a line per stage and every ten seconds.

A stage of one long step shows that it moves by the time that it has taken.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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
_LINE_EVERY_S = 10.0


@contextmanager
def one_step(progress: Callable[[str, int, int], None], stage: str) -> Iterator[None]:
    """Tell the progress of a stage that consists of one step: what is done within."""
    progress(stage, 0, 1)
    yield
    progress(stage, 1, 1)


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
        """Tell that ``done`` of ``total`` items of a stage are finished."""
        if stage not in self._tasks:
            self._tasks[stage] = self._bars.add_task(stage, total=total)
            self._started[stage] = time.monotonic()
        self._bars.update(self._tasks[stage], completed=done, total=total)
        seconds = time.monotonic() - self._started[stage]
        # The end of a step that was over before a line told of it is not worth one.
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
