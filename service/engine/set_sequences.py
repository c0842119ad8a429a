"""A sequence through a set of maps, in the main process: in legs, each of one tile.

A leg begins with an instant that the tile localizes, and lasts as long as no other tile has to.
Instants of two legs know nothing of each other: gaps are filled within a leg.
"""

from __future__ import annotations

import math
from collections.abc import AsyncGenerator, AsyncIterator, Sequence
from contextlib import AsyncExitStack, aclosing
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from service.api.message import inside
from service.engine.catalog import Catalog
from service.engine.instant_tasks import look, without_photos
from service.engine.set_photos import SetPhotos
from service.engine.sets import (
    Choice,
    SetSearch,
    in_set,
    rig_in,
    tile_unavailable,
    with_queries,
)
from service.values import (
    Instant,
    InstantLocalization,
    Query,
    RigJob,
    SequenceStart,
    check_order,
)
from service.workers import process as worker
from service.workers.pool import Workers
from service.workers.process import MapFolder, Seen
from visloc.archive import SetOutline
from visloc.errors import InvalidInput, NotFound, Unavailable, VislocError, refuse
from visloc.pose.centre import moved_pose
from visloc.priors import Priors
from visloc.sequences.filling import guess_time_unit
from visloc.sets.choosing import allowed_tiles, is_clear, nearest_tile
from visloc.sets.handover import Track
from visloc.types import RigPose


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
        self._within: NDArray[np.bool_] | None = None
        self._leg: _Leg | None = None
        self._track: Track | None = None
        self._held = AsyncExitStack()  # keeps the tile of the leg

    def check(self, instants: Sequence[Instant]) -> None:
        """Refuse what can be told of instants before any is worked on, whatever their tiles.

        Raises:
            InvalidInput: ``sequence.timestamps``, ``priors.maps``.
        """
        for index, (before, instant) in enumerate(pairwise(instants), start=1):
            with inside(f"instants[{index}]"):
                check_order(before.timestamp, instant.timestamp)
        for index, instant in enumerate(instants):
            self._check_names(index, instant)

    async def answers(
        self, instants: AsyncIterator[Instant]
    ) -> AsyncGenerator[InstantLocalization]:
        """Answer instants in order, each as soon as its answer is final.

        Raises:
            InvalidInput: as ``Engine.localize_sequence``.
            Unavailable: as ``SetSearch.search``.
        """
        self._within = await self._search.within(self._outline, self._start.maps)
        self._check_tiles(self._start.priors)
        index, before = 0, None
        try:
            async for instant in instants:
                with inside(f"instants[{index}]"):
                    if before is not None:
                        check_order(before, instant.timestamp)
                before = instant.timestamp
                async with aclosing(self._add(index, instant)) as added:
                    async for answer in added:
                        yield answer
                index += 1
            if index == 0:
                raise refuse("sequence.empty", field="instants")
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

    async def _add(self, index: int, instant: Instant) -> AsyncGenerator[InstantLocalization]:
        """Take one more instant; give the answers that are final now."""
        if self._track is not None:
            self._track = self._track.moved(instant.odometry)
        self._check_names(index, instant)
        queries = [image.query for image in instant.images]
        leg = self._leg
        async with self._search.reading(self._of, queries, self._start.options) as photos:
            if leg is None:
                begins = await self._anywhere(index, instant, photos)
            else:
                await photos.rank(None)
                images = with_queries(instant.images, photos.queries)
                looked = await self._look(index, replace(instant, images=images), leg)
                added = await self._added(looked)
                begins = None
                if added.pose is None:
                    begins = await self._elsewhere(index, instant, photos, leg)
        if isinstance(begins, InstantLocalization):
            yield begins
        elif begins is not None:
            for answer in await self._finish():
                yield answer
            for answer in await self._begin(begins):
                yield answer
        elif leg is not None:
            self._leg = replace(leg, state=added.state)
            if added.pose is not None:
                self._follow(leg, instant, added.pose)
            for answer in self._in_set(leg, added.answers):
                yield answer

    def _check_names(self, index: int, instant: Instant) -> None:
        """Refuse names of tiles that the set does not have, also while a leg goes on."""
        if instant.priors is not None:
            with inside(f"instants[{index}]"):
                self._check_tiles(instant.priors)

    def _check_tiles(self, priors: Priors) -> None:
        if priors.maps is not None:
            allowed_tiles(self._outline, Priors(maps=priors.maps))

    def _priors_in(self, row: int, priors: Priors) -> Priors:
        """Say what priors mean in a tile, which may be none of those that they name."""
        found = self._search.priors_in(self._outline, self._outline.tiles[row], priors)
        return replace(found, maps=priors.maps)

    async def _anywhere(
        self, index: int, instant: Instant, photos: SetPhotos
    ) -> _Looked | InstantLocalization:
        """Search the first instant of a leg: looked at in a tile that localizes it, or why not."""
        priors = self._start.priors if instant.priors is None else instant.priors
        with inside(f"instants[{index}]"):
            try:
                allowed = allowed_tiles(self._outline, priors, self._within)
            except NotFound:
                # As in a map: a device may come from outside.
                allowed = np.zeros(len(self._outline.tiles), np.bool_)
                allowed[nearest_tile(self._outline, priors, self._within)] = True
        choice = await self._search.choose(photos, allowed)
        looked, found = await self._searched(index, instant, photos, choice)
        return found if found.answer.pose is None else looked

    async def _elsewhere(
        self, index: int, instant: Instant, photos: SetPhotos, leg: _Leg
    ) -> _Looked | None:
        """Search an instant in the tiles but that of the leg, which does not localize it.

        Returns:
            It, looked at in a tile that begins a new leg with it; None when it stays in the leg:
            no other tile may be where the device is, or says so clearly enough.
        """
        track, priors = self._track, instant.priors or self._start.priors
        seconds = self._seconds_since(track, instant)
        if seconds > self._start.max_gap_s:
            track = None  # nothing is known of it any more
        with inside(f"instants[{index}]"):
            try:
                allowed = allowed_tiles(self._outline, priors, self._within)
                if track is not None and track.knows_motion:
                    area = Priors(position=track.area(self._outline))
                    allowed = allowed_tiles(self._outline, area, allowed)
            except NotFound:
                return None
        allowed[leg.row] = False
        if not photos.seen or not allowed.any():
            return None
        choice = await self._search.choose(photos, allowed)
        if choice.blind:
            return None
        try:
            looked, found = await self._searched(index, instant, photos, choice)
        except (InvalidInput, NotFound):
            return None  # the leg's tile takes what they do not, say a rig that only it knows
        except Unavailable as error:
            if error.code != "set.tile_unavailable":
                raise
            return None
        pose = found.answer.pose
        if pose is None:
            return None
        if track is None or (is_clear(found.answer) and not track.knows_motion):
            return looked
        reach = float(self._outline.reaches[[leg.row, looked.leg.row]].max())
        if track.allows(pose.rig_from_world, pose.covariance, seconds, reach):
            return looked
        return None

    async def _searched(
        self, index: int, instant: Instant, photos: SetPhotos, choice: Choice
    ) -> tuple[_Looked, InstantLocalization]:
        """Search an instant in tiles: looked at in one, and what the set says of it."""
        looked: dict[int, _Looked] = {}

        async def ask(row: int, folder: MapFolder, queries: Sequence[Query]) -> InstantLocalization:
            asked = replace(instant, images=with_queries(instant.images, queries))
            seen = looked[row] = await self._look(index, asked, await self._leg_in(row, folder))
            job = RigJob(
                self._start.maps,
                seen.leg.start.rig,
                seen.instant.images,
                instant.timestamp,
                self._start.options,
                seen.priors,
                ypr=self._start.ypr,
            )
            return await self._workers.run(worker.solve_rig, job, (folder,), seen.seen)

        row, found = await self._search.search(self._outline, choice, photos, ask)
        return looked[row], found

    def _seconds_since(self, track: Track | None, instant: Instant) -> float:
        """Time since the device was last measured; endless when it never was."""
        if track is None:
            return math.inf
        unit = self._start.time_unit or guess_time_unit([track.timestamp])
        assert unit is not None  # the leg has begun
        return (instant.timestamp - track.timestamp) * unit.seconds

    def _follow(self, leg: _Leg, instant: Instant, measured: RigPose) -> None:
        """Note where the device was measured, unless that contradicts how it moved."""
        tile = self._outline.tiles[leg.row]
        moved = tile.set_from_tile.similarity
        pose, covariance = moved_pose(measured.rig_from_world, measured.covariance, moved)
        track, seconds = self._track, self._seconds_since(self._track, instant)
        if track is not None and track.knows_motion and seconds <= self._start.max_gap_s:
            reach = float(self._outline.reaches[leg.row])
            if not track.allows(pose, covariance, seconds, reach):
                return
        metre = 1.0 if self._outline.manifest.world.metric else None
        if instant.odometry is not None:
            metre = moved.scale  # of a metric map, else it would have been refused
        self._track = Track.begun(instant.timestamp, pose, covariance, metre, instant.odometry)

    async def _leg_in(self, row: int, folder: MapFolder) -> _Leg:
        """Begin a leg that has no instant yet."""
        tile = self._outline.tiles[row]
        priors = self._priors_in(row, self._start.priors)
        start = replace(self._start, rig=rig_in(tile, self._start.rig), priors=priors)
        state = await self._workers.run(worker.open_sequence, start, (folder,))
        return _Leg(row, folder, start, state)

    async def _look(self, index: int, instant: Instant, leg: _Leg) -> _Looked:
        """Look at the images of an instant in the tile of a leg."""
        bare = without_photos(instant)
        if bare.priors is not None:
            bare = replace(bare, priors=self._priors_in(leg.row, bare.priors))
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
        """Begin a leg with an instant; the tile stays until the leg ends.

        Raises:
            Unavailable: ``set.tile_unavailable`` when the tile is gone again.
        """
        tile = self._outline.tiles[looked.leg.row]
        using = self._catalog.using((tile.ref,), self._workers)
        try:
            (folder,) = await self._held.enter_async_context(using)
        except NotFound as error:
            raise tile_unavailable(tile, error) from error
        leg = replace(looked.leg, folder=folder)
        added = await self._added(replace(looked, leg=leg))
        self._leg = replace(leg, state=added.state)
        self._track = None
        if added.pose is not None:
            self._follow(leg, looked.instant, added.pose)
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
