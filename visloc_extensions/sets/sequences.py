"""Localizes a sequence in a set of maps: each instant as the set's search does, then all in order.

The search answers an instant in whichever tile. A worker process then takes it as the next one of
the sequence, in the frame of the set.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.engine.instant_tasks import check_and_look, without_photos
from service.values import (
    InstantJob,
    Localization,
    MapFolder,
    PackedSequence,
    PackedSolved,
    Query,
    RigJob,
    SequenceJob,
)
from service.workers.pool import Workers
from service.workers.tasks import Vision
from visloc.archive import SetOutline
from visloc.errors import InvalidInput, NotFound, Unavailable, inside, placed
from visloc.priors import Priors
from visloc_extensions.sets.choosing import allowed_tiles, nearest_tile
from visloc_extensions.sets.search import SetSearch, priors_in, rig_in, with_queries


class SequenceInSet:
    """A sequence in a set."""

    def __init__(
        self, search: SetSearch, workers: Workers, start: SequenceJob, map_set: MapFolder
    ) -> None:
        self._search, self._workers, self._start, self._set = search, workers, start, map_set
        self._outline: SetOutline = search.outline(map_set)
        self._sequence: PackedSequence | None = None
        self._row: int | None = None  # of the tile that localized an instant last

    async def check(self, first: int, instants: Sequence[InstantJob]) -> None:
        await self._checked(first, instants)

    async def add(self, index: int, instant: InstantJob) -> Sequence[Localization]:
        (priors,), cameras = await self._checked(index, [instant])
        with inside(f"instants[{index}]"):
            allowed = await self._allowed(priors)
        job = RigJob(
            self._start.maps,
            self._start.rig,
            instant.images,
            instant.timestamp,
            self._start.options,
            priors,
            ypr=self._start.ypr,
        )
        try:
            row, found, solved = await self._searched(job, allowed, cameras)
        except (InvalidInput, NotFound, Unavailable) as error:
            if isinstance(error, Unavailable) and error.code != "set.tile_unavailable":
                raise
            if self._row is None or not allowed[self._row]:
                of_instant = (error.field or "").startswith("images")
                raise (placed(error, f"instants[{index}]") if of_instant else error) from None
            # Tiles that cannot be opened, or cannot take the images, do not end a sequence that is
            # elsewhere.
            allowed[:] = False
            allowed[self._row] = True
            row, found, solved = await self._searched(job, allowed, cameras)
        if found.answer.pose is not None:
            self._row = row
        bare = replace(instant, images=without_photos(instant.images))
        answers: list[Localization]
        self._sequence, answers = await self._task(
            "add_instant", self._sequence, bare, row, found, solved, priors
        )
        return answers

    async def finish(self) -> Sequence[Localization]:
        answers: list[Localization] = await self._task("finish_sequence", await self._opened())
        return answers

    async def _task(self, name: str, *args: Any) -> Any:
        """Let a worker process do a task of ``TileRanker``."""
        return await self._workers.run(Vision.in_set, self._set, name, *args)

    async def _opened(self) -> PackedSequence:
        if self._sequence is None:
            self._sequence = await self._task("open_sequence", self._start)
        return self._sequence

    async def _checked(
        self, first: int, instants: Sequence[InstantJob]
    ) -> tuple[list[Priors], bytes]:
        bare = [replace(each, images=without_photos(each.images)) for each in instants]
        self._sequence, priors, cameras = await self._task(
            "check_instants", await self._opened(), first, bare
        )
        return priors, cameras

    async def _allowed(self, priors: Priors) -> NDArray[np.bool_]:
        within = await self._search.within(self._outline, self._start.maps)
        try:
            return allowed_tiles(self._outline, priors, within)
        except NotFound:
            # A map does the same: a device may come from outside.
            allowed = np.zeros(len(self._outline.tiles), np.bool_)
            allowed[nearest_tile(self._outline, priors, within)] = True
            return allowed

    async def _searched(
        self, job: RigJob, allowed: NDArray[np.bool_], cameras: bytes
    ) -> tuple[int, Localization, PackedSolved]:
        """Search an instant; return the row of a tile, its answer in the set, and all it found."""
        solved: dict[int, PackedSolved] = {}

        async def ask(row: int, folder: MapFolder, queries: Sequence[Query]) -> Localization:
            tile = self._outline.tiles[row]
            asked = replace(
                job,
                images=with_queries(job.images, queries),
                rig=rig_in(tile, job.rig),
                priors=priors_in(self._outline, tile, job.priors),
            )
            bare, looks = await check_and_look(self._workers, asked, (folder,))
            found, solved[row] = await self._workers.run(
                Vision.solve_instant, bare, folder, looks, cameras
            )
            return found

        photos = self._search.photos(self._set, job)
        choice = await self._search.choose(photos, allowed)
        row, found = await self._search.search(self._outline, choice, photos, ask)
        return row, found, solved[row]


class SetSearches(SetSearch):
    """Searches sets for photos, rigs and sequences."""

    def sequence(self, start: SequenceJob, map_set: MapFolder) -> SequenceInSet:
        return SequenceInSet(self, self._workers, start, map_set)
