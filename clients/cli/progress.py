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
    """Run ``work`` in an event loop, with a progress bar.

    Args:
        work: takes the function that advances the bar by one.
        if_stopped: tells the person who stops the run what becomes of it.
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
