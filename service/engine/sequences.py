"""A sequence in the main process: one task after another for each instant."""

from __future__ import annotations

from collections.abc import AsyncGenerator, AsyncIterator, Sequence
from dataclasses import replace
from typing import Protocol

from service.engine.instant_tasks import look, without_photos
from service.values import InstantJob, Localization, MapFolder, PackedSequence, SequenceJob
from service.workers.pool import Workers
from service.workers.tasks import Vision
from visloc.errors import VislocError, refuse
from visloc.priors import NO_PRIORS, Priors


class SequenceSearch(Protocol):
    """Localizes a sequence; its instants are checked and added in order."""

    async def check(self, first: int, instants: Sequence[InstantJob]) -> None:
        """Refuse instants, the first of this index, that cannot be solved, before any work."""

    async def add(self, index: int, instant: InstantJob) -> Sequence[Localization]:
        """Localize the next instant; return the answers that are final now."""

    async def finish(self) -> Sequence[Localization]:
        """Return the answers that are still waiting, when no more instants come."""


async def answers_in_order(
    search: SequenceSearch, instants: AsyncIterator[InstantJob] | Sequence[InstantJob]
) -> AsyncGenerator[Localization]:
    """Answer instants in order, each as soon as its answer is final.

    Errors are as in ``Engine.localize_sequence``.
    """
    if isinstance(instants, Sequence):
        await search.check(0, instants)
    index = 0
    try:
        async for instant in _in_turn(instants):
            for answer in await search.add(index, instant):
                yield answer
            index += 1
    except VislocError:
        # An error of one instant does not discard the answers before it.
        if index > 0:
            for answer in await search.finish():
                yield answer
        raise
    for answer in await search.finish():
        yield answer


class SequenceInMaps:
    """A sequence in one map, or in several until one of them is settled on."""

    def __init__(self, workers: Workers, start: SequenceJob, maps: tuple[MapFolder, ...]) -> None:
        self._workers, self._start, self._maps = workers, start, maps
        self._sequence: PackedSequence | None = None

    async def check(self, first: int, instants: Sequence[InstantJob]) -> None:
        for instant in instants:
            check_no_tiles(self._maps, instant.priors or NO_PRIORS)
        await self._checked(first, instants)

    async def add(self, index: int, instant: InstantJob) -> Sequence[Localization]:
        workers, start = self._workers, self._start
        (priors,) = await self._checked(index, [instant])
        check_no_tiles(self._maps, priors)
        looks = await look(workers, self._maps, start.rig, instant.images, start.options, priors)
        step = await workers.run(
            Vision.add_instant, await self._opened(), self._maps, _bare(instant), looks, priors
        )
        self._sequence = step.sequence
        self._maps = tuple(each for each in self._maps if each.ref in step.maps)
        return step.answers

    async def finish(self) -> Sequence[Localization]:
        sequence = await self._opened()
        return await self._workers.run(Vision.finish_sequence, sequence, self._maps)

    async def _opened(self) -> PackedSequence:
        if self._sequence is None:
            self._sequence = await self._workers.run(Vision.open_sequence, self._start, self._maps)
        return self._sequence

    async def _checked(self, first: int, instants: Sequence[InstantJob]) -> list[Priors]:
        bare = [_bare(instant) for instant in instants]
        self._sequence, priors = await self._workers.run(
            Vision.check_instants, await self._opened(), self._maps, first, bare
        )
        return priors


def check_no_tiles(maps: Sequence[MapFolder], priors: Priors) -> None:
    """Refuse priors that name tiles for maps that have none."""
    if priors.maps is not None:
        raise refuse(
            "priors.maps",
            "only a set of maps has tiles",
            field="priors.maps",
            expected="a set of maps, or none of this",
            got=", ".join(each.ref for each in maps),
        )


def _bare(instant: InstantJob) -> InstantJob:
    """Return an instant for checks and tasks that do not need its photos."""
    return replace(instant, images=without_photos(instant.images))


async def _in_turn(
    instants: AsyncIterator[InstantJob] | Sequence[InstantJob],
) -> AsyncGenerator[InstantJob]:
    if isinstance(instants, Sequence):
        for instant in instants:
            yield instant
    else:
        async for instant in instants:
            yield instant
