"""Localizes a sequence in a set of maps, in the main process.

The sequence is cut into legs, each in one tile. A leg begins with an instant that the tile
localizes, and ends when another tile takes over. Gaps are filled within a leg, never between two.
"""

from __future__ import annotations

import math
from collections.abc import AsyncGenerator, AsyncIterator, Sequence
from contextlib import AsyncExitStack, aclosing
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from service.engine.catalog import Catalog
from service.engine.instant_tasks import look, without_photos
from service.engine.set_photos import SetPhotos
from service.engine.sets import (
    Choice,
    SetSearch,
    in_set,
    priors_in,
    rig_in,
    tile_unavailable,
    with_queries,
)
from service.values import (
    InstantJob,
    Localization,
    MapFolder,
    PackedLooks,
    PackedSequence,
    Query,
    RigJob,
    SequenceJob,
    SequenceStep,
    check_order,
)
from service.workers.judging import gated
from service.workers.pool import Workers
from service.workers.tasks import Vision
from visloc.archive import SetOutline
from visloc.errors import InvalidInput, NotFound, Unavailable, VislocError, inside, refuse
from visloc.pose.motion import moved_pose
from visloc.priors import Priors
from visloc.sequences.filling import guess_time_unit
from visloc.sets.choosing import allowed_tiles, is_clear, nearest_tile
from visloc.sets.handover import Track
from visloc.types import RigPose


@dataclass(frozen=True, slots=True, eq=False)
class _Leg:
    """A run of instants in the tile of this row; ``start`` is in the tile's frame."""

    row: int
    folder: MapFolder
    start: SequenceJob
    sequence: PackedSequence


@dataclass(frozen=True, slots=True, eq=False)
class _Pending:
    """An instant that was looked at in a tile, and is not added to the leg yet.

    Attributes:
        instant: without photos.
        priors: in the tile's frame.
    """

    leg: _Leg
    instant: InstantJob
    looks: list[PackedLooks]
    priors: Priors


class SetSequence:
    """One sequence that is localized in a set."""

    def __init__(
        self,
        search: SetSearch,
        catalog: Catalog,
        workers: Workers,
        start: SequenceJob,
        map_set: MapFolder,
    ) -> None:
        self._search, self._catalog, self._workers = search, catalog, workers
        self._start, self._set = start, map_set
        self._outline: SetOutline = catalog.set_outline(map_set)
        self._within: NDArray[np.bool_] | None = None
        self._leg: _Leg | None = None
        self._track: Track | None = None
        self._held = AsyncExitStack()  # holds the tile of the leg

    def check(self, instants: Sequence[InstantJob]) -> None:
        """Refuse instants that no tile can take, before any work."""
        for index, (before, instant) in enumerate(pairwise(instants), start=1):
            with inside(f"instants[{index}]"):
                check_order(before.timestamp, instant.timestamp)
        for index, instant in enumerate(instants):
            self._check_names(index, instant)

    async def answers(self, instants: AsyncIterator[InstantJob]) -> AsyncGenerator[Localization]:
        """Answer instants in order, each as soon as its answer is final.

        Errors are those of ``Engine.localize_sequence`` and ``SetSearch.search``.
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
            # An error of one instant does not discard the answers before it.
            for answer in await self._finish():
                yield answer
            raise
        else:
            for answer in await self._finish():
                yield answer
        finally:
            await self._held.aclose()

    async def _add(self, index: int, instant: InstantJob) -> AsyncGenerator[Localization]:
        """Take the next instant; give the answers that are final now."""
        if self._track is not None:
            self._track = self._track.moved(instant.odometry)
        self._check_names(index, instant)
        queries = [image.query for image in instant.images]
        leg = self._leg
        async with self._search.decoding(self._set, queries, self._start.options) as photos:
            if leg is None:
                begins = await self._anywhere(index, instant, photos)
            else:
                await photos.rank(None)
                images = with_queries(instant.images, photos.queries)
                pending = await self._look(index, replace(instant, images=images), leg)
                added = await self._added(pending)
                begins = None
                if added.pose is None:
                    begins = await self._elsewhere(index, instant, photos, leg)
        if isinstance(begins, Localization):
            yield begins
        elif begins is not None:
            for answer in await self._finish():
                yield answer
            for answer in await self._begin(begins):
                yield answer
        elif leg is not None:
            self._leg = replace(leg, sequence=added.sequence)
            if added.pose is not None:
                self._follow(leg, instant, added.pose)
            for answer in self._in_set(leg, added.answers):
                yield answer

    def _check_names(self, index: int, instant: InstantJob) -> None:
        """Refuse names of tiles that the set does not have, also within a leg."""
        if instant.priors is not None:
            with inside(f"instants[{index}]"):
                self._check_tiles(instant.priors)

    def _check_tiles(self, priors: Priors) -> None:
        if priors.maps is not None:
            allowed_tiles(self._outline, Priors(maps=priors.maps))

    def _priors_in(self, row: int, priors: Priors) -> Priors:
        """Move priors to a tile's frame, also if they do not name the tile."""
        moved = priors_in(self._outline, self._outline.tiles[row], priors)
        return replace(moved, maps=priors.maps)

    async def _anywhere(
        self, index: int, instant: InstantJob, photos: SetPhotos
    ) -> _Pending | Localization:
        """Search all tiles for the first instant of a leg; return a refusal if none has it."""
        priors = self._start.priors if instant.priors is None else instant.priors
        with inside(f"instants[{index}]"):
            try:
                allowed = allowed_tiles(self._outline, priors, self._within)
            except NotFound:
                # A map does the same: a device may come from outside.
                allowed = np.zeros(len(self._outline.tiles), np.bool_)
                allowed[nearest_tile(self._outline, priors, self._within)] = True
        choice = await self._search.choose(photos, allowed)
        pending, found = await self._searched(index, instant, photos, choice)
        return found if found.answer.pose is None else pending

    async def _elsewhere(
        self, index: int, instant: InstantJob, photos: SetPhotos, leg: _Leg
    ) -> _Pending | None:
        """Search the other tiles for an instant that the leg's tile does not localize.

        Returns:
            The instant in a tile that begins a new leg with it. None if it stays in the leg,
            because no other tile is allowed, or none localizes it at a plausible place.
        """
        track, priors = self._track, instant.priors or self._start.priors
        seconds = self._seconds_since(track, instant)
        if seconds > self._start.max_gap_s:
            track = None  # too old to say anything
        with inside(f"instants[{index}]"):
            try:
                allowed = allowed_tiles(self._outline, priors, self._within)
                if track is not None and track.knows_motion:
                    area = Priors(position=track.area(self._outline))
                    allowed = allowed_tiles(self._outline, area, allowed)
            except NotFound:
                return None
        allowed[leg.row] = False
        if not photos.any_decoded or not allowed.any():
            return None
        choice = await self._search.choose(photos, allowed)
        if choice.blind:
            return None
        try:
            pending, found = await self._searched(index, instant, photos, choice)
        except (InvalidInput, NotFound):
            return None  # it stays with the leg's tile, perhaps because only that knows the rig
        except Unavailable as error:
            if error.code != "set.tile_unavailable":
                raise
            return None
        pose = found.answer.pose
        if pose is None:
            return None
        if track is None or (is_clear(found.answer) and not track.knows_motion):
            return pending
        reach = float(self._outline.reaches[[leg.row, pending.leg.row]].max())
        if track.allows(pose.rig_from_world, pose.covariance, seconds, reach):
            return pending
        return None

    async def _searched(
        self, index: int, instant: InstantJob, photos: SetPhotos, choice: Choice
    ) -> tuple[_Pending, Localization]:
        """Search an instant in tiles; return it in the best one, with the answer."""
        pending: dict[int, _Pending] = {}

        async def ask(row: int, folder: MapFolder, queries: Sequence[Query]) -> Localization:
            asked = replace(instant, images=with_queries(instant.images, queries))
            one = pending[row] = await self._look(index, asked, await self._leg_in(row, folder))
            job = RigJob(
                self._start.maps,
                one.leg.start.rig,
                one.instant.images,
                instant.timestamp,
                self._start.options,
                one.priors,
                ypr=self._start.ypr,
            )
            return await self._workers.run(Vision.solve_rig, job, (folder,), one.looks)

        row, found = await self._search.search(self._outline, choice, photos, ask)
        return pending[row], gated(found, self._start.options)

    def _seconds_since(self, track: Track | None, instant: InstantJob) -> float:
        """Return the time since the last measured pose; infinite without one."""
        if track is None:
            return math.inf
        unit = self._start.time_unit or guess_time_unit([track.timestamp])
        assert unit is not None  # the leg has begun
        return (instant.timestamp - track.timestamp) * unit.seconds

    def _follow(self, leg: _Leg, instant: InstantJob, measured: RigPose) -> None:
        """Update the track with a measured pose, unless the known motion contradicts it."""
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
            metre = moved.scale  # the map is metric: others refuse odometry
        self._track = Track.begun(instant.timestamp, pose, covariance, metre, instant.odometry)

    async def _leg_in(self, row: int, folder: MapFolder) -> _Leg:
        """Return a leg without instants."""
        tile = self._outline.tiles[row]
        priors = self._priors_in(row, self._start.priors)
        start = replace(self._start, rig=rig_in(tile, self._start.rig), priors=priors)
        sequence = await self._workers.run(Vision.open_sequence, start, (folder,))
        return _Leg(row, folder, start, sequence)

    async def _look(self, index: int, instant: InstantJob, leg: _Leg) -> _Pending:
        """Look at the images of an instant in the tile of a leg."""
        bare = replace(instant, images=without_photos(instant.images))
        if bare.priors is not None:
            bare = replace(bare, priors=self._priors_in(leg.row, bare.priors))
        maps = (leg.folder,)
        sequence, (priors,) = await self._workers.run(
            Vision.check_instants, leg.sequence, maps, index, [bare]
        )
        options = self._start.options
        looks = await look(self._workers, maps, leg.start.rig, instant.images, options, priors)
        return _Pending(replace(leg, sequence=sequence), bare, looks, priors)

    async def _added(self, pending: _Pending) -> SequenceStep:
        leg = pending.leg
        return await self._workers.run(
            Vision.add_instant,
            leg.sequence,
            (leg.folder,),
            pending.instant,
            pending.looks,
            pending.priors,
        )

    async def _begin(self, pending: _Pending) -> list[Localization]:
        """Begin a leg with an instant, and hold the tile until the leg ends."""
        tile = self._outline.tiles[pending.leg.row]
        using = self._catalog.using((tile.ref,))
        try:
            (folder,) = await self._held.enter_async_context(using)
        except NotFound as error:
            raise tile_unavailable(tile, error) from error
        leg = replace(pending.leg, folder=folder)
        added = await self._added(replace(pending, leg=leg))
        self._leg = replace(leg, sequence=added.sequence)
        self._track = None
        if added.pose is not None:
            self._follow(leg, pending.instant, added.pose)
        return self._in_set(leg, added.answers)

    async def _finish(self) -> list[Localization]:
        """End the leg, and return its remaining answers."""
        leg, self._leg = self._leg, None
        if leg is None:
            return []
        answers = await self._workers.run(Vision.finish_sequence, leg.sequence, (leg.folder,))
        await self._held.aclose()
        return self._in_set(leg, answers)

    def _in_set(self, leg: _Leg, answers: Sequence[Localization]) -> list[Localization]:
        tile = self._outline.tiles[leg.row]
        return [in_set(answer, self._outline, tile) for answer in answers]
