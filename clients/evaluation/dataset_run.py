"""Asking about a whole dataset, with the time that it takes."""

from __future__ import annotations

import time
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import Any

from rich.console import Console

from clients.cli.progress import run_with_progress
from clients.client import AsyncClient
from clients.evaluation.benchmark import Run
from clients.evaluation.modes import Arrangement
from clients.evaluation.readers import Reader
from clients.evaluation.run import InstantOutcome, Outcome, localize_all, localize_instants
from clients.wire.types import LocalizeOptions


@dataclass(frozen=True, slots=True, eq=False)
class Asking:
    """What does not change while a dataset is asked about.

    Attributes:
        connect: makes a client of the server.
        map_ref: ``id@version``.
        options: for every answer.
        concurrency: how many requests run at once.
        read: gives what is sent of a photo.
        console: for the progress bar.
    """

    connect: Callable[[], AsyncClient]
    map_ref: str
    options: LocalizeOptions
    concurrency: int
    read: Reader
    console: Console

    def photos(self, arrangement: Arrangement) -> Run:
        """Ask about each photo."""
        outcomes: dict[str, Outcome] = {}

        async def work(client: AsyncClient, advance: Callable[[], None]) -> None:
            def keep(outcome: Outcome) -> None:
                outcomes[outcome.query.name] = outcome
                advance()

            await localize_all(
                *(client, arrangement.photos, self.map_ref, self.options, self.concurrency),
                *(keep, self.read),
            )

        seconds = self._timed(work, "photos", len(arrangement.photos))
        return Run.of_photos([outcomes[query.name] for query in arrangement.photos], seconds)

    def instants(self, arrangement: Arrangement) -> Run:
        """Ask about each instant."""
        outcomes: list[InstantOutcome] = []

        async def work(client: AsyncClient, advance: Callable[[], None]) -> None:
            def keep(outcome: InstantOutcome) -> None:
                outcomes.append(outcome)
                advance()

            await localize_instants(
                *(client, arrangement.asked, self.map_ref, self.options, self.concurrency),
                *(keep, self.read),
            )

        seconds = self._timed(work, "instants", len(arrangement.asked))
        return Run.of_instants(outcomes, arrangement.photos, seconds)

    def _timed(
        self,
        work: Callable[[AsyncClient, Callable[[], None]], Coroutine[Any, Any, None]],
        what: str,
        total: int,
    ) -> float:
        seconds = 0.0

        async def run(advance: Callable[[], None]) -> None:
            nonlocal seconds
            async with self.connect() as client:
                started = time.perf_counter()
                await work(client, advance)
                seconds = time.perf_counter() - started

        run_with_progress(self.console, run, what, total, "no report was written")
        return seconds
