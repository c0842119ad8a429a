"""A sequence through a set of maps, in the main process: in legs, each of one tile.

A leg begins with an instant that the tile localizes, and lasts as long as no other tile has to.
Instants of two legs know nothing of each other: gaps are filled within a leg.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator, AsyncIterator, Sequence
from contextlib import AsyncExitStack
from dataclasses import dataclass, replace
from time import time

from service import worker
from service.catalog import Catalog
from service.incoming import inside
from service.instant_tasks import look, without_photos
from service.jobs import Instant, InstantLocalization, RigJob, SequenceStart, check_order
from service.set_search import SetSearch, in_set, rig_in, with_queries
from service.worker import MapFolder, Seen
from service.workers import Workers
from visloc.archive import SetOutline
from visloc.errors import InvalidInput, NotFound, VislocError
from visloc.priors import Priors
from visloc.sets.choosing import allowed_tiles


@dataclass(frozen=True, slots=True, eq=False)
class _Leg:
    """A run of instants in one tile.

    Attributes:
        row: of the tile.
        folder: where the tile lies.
        start: what its instants share, in the tile's frame.
        state: what only worker processes read.
    """

    row: int
    folder: MapFolder
    start: SequenceStart
    state: bytes


@dataclass(frozen=True, slots=True, eq=False)
class _Looked:
    """An instant that was looked at in a tile, not added to the leg yet.

    Attributes:
        leg: as it was checked with the instant.
        instant: without photos.
        seen: what its images show.
        priors: in the tile's frame.
    """

    leg: _Leg
    instant: Instant
    seen: list[Seen]
    priors: Priors


class SetSequence:
    """One sequence that is localized in a set.

    Args:
        search: of sets.
        catalog: gives the tiles.
        workers: do the work.
        start: what all instants share.
        of: the set.
    """

    def __init__(
        self,
        search: SetSearch,
        catalog: Catalog,
        workers: Workers,
        start: SequenceStart,
        of: MapFolder,
    ) -> None:
        self._search, self._catalog, self._workers = search, catalog, workers
        self._start, self._of = start, of
        self._outline: SetOutline = catalog.set_outline(of)
        self._leg: _Leg | None = None
        self._held = AsyncExitStack()  # keeps the tile of the leg

    async def answers(
        self, instants: AsyncIterator[Instant]
    ) -> AsyncGenerator[InstantLocalization]:
        """Answer instants in order, each as soon as its answer is final.

        Raises:
            InvalidInput: as ``Engine.localize_sequence``.
            NotFound: ``set.no_tile``.
            Unavailable: as ``SetSearch.search``.
        """
        index, before = 0, None
        try:
            async for instant in instants:
                with inside(f"instants[{index}]"):
                    if before is not None:
                        check_order(before, instant.timestamp)
                before = instant.timestamp
                async with self._search.place:
                    answers = await self._add(index, instant)
                for answer in answers:
                    yield answer
                index += 1
            if index == 0:
                raise InvalidInput("sequence.empty", "there is no instant", field="instants")
        except VislocError:
            # What is wrong with one instant does not take the answers of those before it along.
            for answer in await self._finish():
                yield answer
            raise
        else:
            for answer in await self._finish():
                yield answer
        finally:
            await self._held.aclose()

    async def _add(self, index: int, instant: Instant) -> list[InstantLocalization]:
        """Take one more instant; return the answers that are final now."""
        leg = self._leg
        if leg is None:
            found = await self._elsewhere(index, instant)
            if isinstance(found, _Looked):
                return await self._begin(found)
            return [] if found is None else [found]
        queries = [image.query for image in instant.images]
        read = await self._search.read(self._of, queries, self._start.options, None, time())
        images = with_queries(instant.images, [one.query for one in read])
        instant = replace(instant, images=images)
        looked = await self._look(index, instant, leg)
        added = await self._added(looked)
        if not added.localized:
            found = await self._elsewhere(index, instant)
            if isinstance(found, _Looked):
                return [*await self._finish(), *await self._begin(found)]
        self._leg = replace(leg, state=added.state)
        return self._in_set(leg, added.answers)

    async def _elsewhere(
        self, index: int, instant: Instant
    ) -> _Looked | InstantLocalization | None:
        """Search an instant in the tiles but that of the leg.

        Returns:
            It, looked at in a tile that localizes it; else why none does; None when no other tile
            is allowed.

        Raises:
            NotFound: ``set.no_tile`` unless there is a leg.
        """
        priors = self._start.priors if instant.priors is None else instant.priors
        with inside(f"instants[{index}]"):
            try:
                allowed = allowed_tiles(self._outline, priors)
            except NotFound:
                if self._leg is None:
                    raise
                return None
        if self._leg is not None:
            allowed[self._leg.row] = False
            if not allowed.any():
                return None
        queries = [image.query for image in instant.images]
        options = self._start.options
        choice = await self._search.choose(self._of, queries, options, allowed, time())
        asked = replace(instant, images=with_queries(instant.images, choice.queries))
        looked: dict[int, _Looked] = {}

        async def ask(row: int, folder: MapFolder) -> InstantLocalization:
            seen = looked[row] = await self._look(index, asked, await self._leg_in(row, folder))
            job = RigJob(
                self._start.maps,
                seen.leg.start.rig,
                seen.instant.images,
                instant.timestamp,
                options,
                seen.priors,
                ypr=self._start.ypr,
            )
            return await self._workers.run(worker.solve_rig, job, (folder,), seen.seen)

        row, found = await self._search.search(self._outline, choice, ask)
        return found if found.answer.pose is None else looked[row]

    async def _leg_in(self, row: int, folder: MapFolder) -> _Leg:
        """Begin a leg that has no instant yet."""
        tile = self._outline.tiles[row]
        priors = self._search.priors_in(self._outline, tile, self._start.priors)
        start = replace(self._start, rig=rig_in(tile, self._start.rig), priors=priors)
        state = await self._workers.run(worker.open_sequence, start, (folder,))
        return _Leg(row, folder, start, state)

    async def _look(self, index: int, instant: Instant, leg: _Leg) -> _Looked:
        """Look at the images of an instant in the tile of a leg."""
        bare = without_photos(instant)
        if bare.priors is not None:
            tile = self._outline.tiles[leg.row]
            priors = self._search.priors_in(self._outline, tile, bare.priors)
            bare = replace(bare, priors=priors)
        maps = (leg.folder,)
        state, known = await self._workers.run(
            worker.check_instants, leg.state, maps, index, [bare]
        )
        options = self._start.options
        seen = await look(self._workers, maps, leg.start.rig, instant.images, options, known[0])
        return _Looked(replace(leg, state=state), bare, seen, known[0])

    async def _added(self, looked: _Looked) -> worker.Added:
        leg = looked.leg
        return await self._workers.run(
            worker.add_instant,
            leg.state,
            (leg.folder,),
            looked.instant,
            looked.seen,
            looked.priors,
        )

    async def _begin(self, looked: _Looked) -> list[InstantLocalization]:
        """Begin a leg with an instant; the tile stays until the leg ends."""
        tile = self._outline.tiles[looked.leg.row]
        using = self._catalog.using((tile.ref,), self._workers)
        (folder,) = await self._held.enter_async_context(using)
        leg = replace(looked.leg, folder=folder)
        added = await self._added(replace(looked, leg=leg))
        self._leg = replace(leg, state=added.state)
        return self._in_set(leg, added.answers)

    async def _finish(self) -> list[InstantLocalization]:
        """End the leg; return the answers that waited for instants which will not come."""
        leg, self._leg = self._leg, None
        if leg is None:
            return []
        answers = await self._workers.run(worker.finish_sequence, leg.state, (leg.folder,))
        await self._held.aclose()
        return self._in_set(leg, answers)

    def _in_set(
        self, leg: _Leg, answers: Sequence[InstantLocalization]
    ) -> list[InstantLocalization]:
        tile = self._outline.tiles[leg.row]
        return [in_set(answer, self._outline, tile) for answer in answers]
