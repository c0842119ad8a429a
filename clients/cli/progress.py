"""A progress bar over a run that can be stopped."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from visloc.errors import VislocError

EXIT_STOPPED = 130


def run_with_progress(
    console: Console,
    work: Callable[[Callable[[], None]], Coroutine[Any, Any, None]],
    what: str,
    total: int,
    if_stopped: str,
) -> None:
    """Run ``work``, which calls what it is given after each answer.

    Args:
        console: for the bar.
        work: what to run in an event loop.
        what: is counted.
        total: how many there are.
        if_stopped: what that means, for the person who stops it.
    """
    columns = (
        TextColumn(what),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as progress:
        task = progress.add_task(what, total=total)
        try:
            asyncio.run(work(lambda: progress.advance(task)))
        except KeyboardInterrupt:
            progress.stop()
            console.print(f"stopped; {if_stopped}", highlight=False)
            raise typer.Exit(EXIT_STOPPED) from None
        except VislocError:
            progress.stop()
            console.print(f"cannot go on; {if_stopped}", highlight=False)
            raise
