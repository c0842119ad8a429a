"""Sets of maps, in the main process: which tiles are searched, and one answer of theirs.

A worker process reads a photo once and ranks the tiles that the priors allow; the best are searched
as any map is, with what was read; what they say is put into the set's frame and judged together.
"""

from __future__ import annotations

import asyncio
from collections import defaultdict
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from dataclasses import dataclass, replace
from time import time
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from service import worker
from service.catalog import Catalog
from service.instant_tasks import solve_rig
from service.jobs import (
    ImageJob,
    InstantLocalization,
    Localization,
    LocalizeJob,
    Query,
    Rig,
    RigJob,
)
from service.metrics import Metrics
from service.together import together
from service.worker import Chosen, MapFolder
from service.workers import Workers
from visloc.archive import SetOutline, TileRecord
from visloc.errors import (
    Conflict,
    InvalidInput,
    MapCorrupt,
    NotFound,
    Unavailable,
    VislocError,
)
from visloc.priors import Priors
from visloc.sets.choosing import (
    Found,
    TileScore,
    allowed_tiles,
    inliers_of,
    is_clear,
    judge,
    plan,
)
from visloc.sets.frame import answer_in_set, priors_in_tile, scaled_device
from visloc.types import InstantAnswer, Localized, LocalizeOptions, NotLocalized, Refusal

AnyLocalization = TypeVar("AnyLocalization", Localization, InstantLocalization)
T = TypeVar("T")

# Codes that begin so say that a map cannot be had.
_OF_A_MAP = ("map.", "maps.")


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """Where to look for what a caller asked of a set.

    Attributes:
        first: rows of the tiles to search.
        rest: those to search when none of the first has a clear answer.
        queries: the photos, read where they could be.
    """

    first: tuple[int, ...]
    rest: tuple[int, ...]
    queries: tuple[Query, ...]


class SetSearch:
    """Searches sets of maps. Used from one event loop.

    Args:
        catalog: gives the tiles.
        workers: do the work.
        metrics: count the tiles that were searched.

    Attributes:
        place: held from when a photo is read until its tiles were searched.
    """

    def __init__(self, catalog: Catalog, workers: Workers, metrics: Metrics) -> None:
        self._catalog, self._workers, self._metrics = catalog, workers, metrics
        # Photos that were read are much larger than those that wait.
        self.place = asyncio.Semaphore(workers.count + 1)

    async def localize(self, job: LocalizeJob, of: MapFolder) -> Localization:
        """Localize a photo, or its features, in a set.

        Raises:
            InvalidInput: ``priors.*``, and what the tiles' maps raise.
            NotFound: ``set.no_tile`` when the priors allow no tile.
            Unavailable: ``set.tile_unavailable``, ``server.worker_died``.
        """
        submitted = time()
        outline = self._catalog.set_outline(of)
        allowed = allowed_tiles(outline, job.priors)
        async with self.place:
            choice = await self.choose(of, [job.query], job.options, allowed, submitted)
            (query,) = choice.queries

            async def ask(row: int, folder: MapFolder) -> Localization:
                priors = self.priors_in(outline, outline.tiles[row], job.priors)
                asked = replace(job, query=query, priors=priors)
                return await self._workers.run(worker.localize, asked, (folder,), time())

            _, found = await self.search(outline, choice, ask)
            return found

    async def localize_rig(self, job: RigJob, of: MapFolder) -> InstantLocalization:
        """Localize the images of one instant together in a set; errors as of ``localize``."""
        submitted = time()
        outline = self._catalog.set_outline(of)
        allowed = allowed_tiles(outline, job.priors)
        async with self.place:
            queries = [image.query for image in job.images]
            choice = await self.choose(of, queries, job.options, allowed, submitted)
            images = with_queries(job.images, choice.queries)

            async def ask(row: int, folder: MapFolder) -> InstantLocalization:
                tile = outline.tiles[row]
                asked = replace(
                    job,
                    images=images,
                    rig=rig_in(tile, job.rig),
                    priors=self.priors_in(outline, tile, job.priors),
                )
                return await solve_rig(self._workers, asked, (folder,))

            _, found = await self.search(outline, choice, ask)
            return found

    async def choose(
        self,
        of: MapFolder,
        queries: Sequence[Query],
        options: LocalizeOptions,
        allowed: NDArray[np.bool_],
        submitted: float,
    ) -> Choice:
        """Read photos, and say which of the allowed tiles to search.

        Photos of one instant count together: by the sum of what they say of a tile.
        """
        rows = np.flatnonzero(allowed)
        asked = allowed if len(rows) > 1 else None
        chosen = await self.read(of, queries, options, asked, submitted)
        scores: dict[int, float] = defaultdict(float)
        for one in chosen:
            for each in one.scores:
                scores[each.tile] += each.score
        best_first = sorted(scores, key=lambda tile: -scores[tile])
        # What shows nothing is told so by any tile.
        ranked = [TileScore(tile, scores[tile]) for tile in best_first] or [
            TileScore(int(rows[0]), 0.0)
        ]
        first, rest = plan(ranked)
        return Choice(first, rest, tuple(one.query for one in chosen))

    async def read(
        self,
        of: MapFolder,
        queries: Sequence[Query],
        options: LocalizeOptions,
        allowed: NDArray[np.bool_] | None,
        submitted: float,
    ) -> list[Chosen]:
        """Read photos, and rank tiles by each; arguments as of ``worker.choose_tiles``."""
        return await together(
            self._workers.run(worker.choose_tiles, query, of, options, allowed, submitted)
            for query in queries
        )

    def priors_in(self, outline: SetOutline, tile: TileRecord, priors: Priors) -> Priors:
        """Say what priors of the set's frame mean in that of a tile."""
        return priors_in_tile(priors, tile.set_from_tile.similarity, outline.gravity)

    async def search(
        self,
        outline: SetOutline,
        choice: Choice,
        ask: Callable[[int, MapFolder], Awaitable[AnyLocalization]],
    ) -> tuple[int, AnyLocalization]:
        """Search tiles, and judge what they say.

        Args:
            outline: of the set.
            choice: where to look.
            ask: searches one tile, given by its row, in its own frame.

        Returns:
            The row of a tile, and one answer, in the set's frame.

        Raises:
            Unavailable: ``set.tile_unavailable`` for a tile that cannot be opened, unless another
                one has a clear answer.
            VislocError: what ``ask`` raises.
        """
        found: list[tuple[int, AnyLocalization]] = []
        missing: list[tuple[TileRecord, VislocError]] = []
        for rows in (choice.first, choice.rest):
            if any(is_clear(each.answer) for _, each in found):
                break
            for row, each in await self._asked(outline, rows, ask):
                if isinstance(each, VislocError):
                    missing.append((outline.tiles[row], each))
                else:
                    found.append((row, each))
        self._metrics.observe_tiles(len(found))
        if missing and not any(is_clear(each.answer) for _, each in found):
            tile, error = missing[0]
            raise Unavailable(
                "set.tile_unavailable",
                f"a tile of the set that may show this cannot be opened: {error.message}",
                field="map",
                expected=tile.ref,
                got=error.code,
            ) from error
        return _judged(outline, found)

    async def _asked(
        self,
        outline: SetOutline,
        rows: Sequence[int],
        ask: Callable[[int, MapFolder], Awaitable[AnyLocalization]],
    ) -> list[tuple[int, AnyLocalization | VislocError]]:
        """Search tiles at once; of one that cannot be had, say why."""

        async def of(row: int) -> tuple[int, AnyLocalization | VislocError]:
            tile = outline.tiles[row]
            try:
                async with self._catalog.using((tile.ref,), self._workers) as (folder,):
                    return row, in_set(await ask(row, folder), outline, tile)
            except (NotFound, MapCorrupt, Conflict, Unavailable) as error:
                if not error.code.startswith(_OF_A_MAP):
                    raise
                return row, error

        return await together(of(row) for row in rows)


async def answers_of(searches: Sequence[Coroutine[Any, Any, T]]) -> list[T]:
    """Search maps and sets at once; a set of which the priors leave nothing does not count.

    Raises:
        NotFound: ``set.no_tile`` when nothing else is searched.
    """

    async def of(search: Coroutine[Any, Any, T]) -> T | NotFound:
        try:
            return await search
        except NotFound as error:
            if error.code != "set.no_tile":
                raise
            return error

    found = await together(of(search) for search in searches)
    answers = [each for each in found if not isinstance(each, NotFound)]
    nothing = [each for each in found if isinstance(each, NotFound)]
    if not answers:
        raise nothing[0]
    return answers


def parted(
    maps: Sequence[MapFolder], priors: Priors
) -> tuple[tuple[MapFolder, ...], tuple[MapFolder, ...]]:
    """Part sets of maps from maps on their own.

    Raises:
        InvalidInput: ``priors.maps`` when it names tiles where there is none.
    """
    sets = tuple(of for of in maps if of.is_set)
    alone = tuple(of for of in maps if not of.is_set)
    if alone:
        check_no_tiles(alone, priors)
    return sets, alone


def check_no_tiles(maps: Sequence[MapFolder], priors: Priors) -> None:
    """Refuse priors that name tiles for maps that have none.

    Raises:
        InvalidInput: ``priors.maps``.
    """
    if priors.maps is not None:
        raise InvalidInput(
            "priors.maps",
            "only a set of maps has tiles",
            field="priors.maps",
            expected="a set of maps, or none of this",
            got=", ".join(of.ref for of in maps),
        )


def in_set(found: AnyLocalization, outline: SetOutline, tile: TileRecord) -> AnyLocalization:
    """Move what a tile answered to the set's frame, and name both."""
    moved = tile.set_from_tile.similarity
    found = replace(
        found,
        map_id=outline.manifest.id,
        map_version=outline.manifest.version,
        geodetic=outline.geodetic,
        tile=tile.ref,
    )
    if isinstance(found, InstantLocalization):
        return replace(found, answer=answer_in_set(found.answer, moved))
    debug = found.debug
    if debug is not None:
        debug = replace(debug, points=moved.apply(debug.points))
    if isinstance(found.answer, Localized):
        return replace(found, answer=answer_in_set(found.answer, moved), debug=debug)
    return replace(found, debug=debug)


def rig_in(tile: TileRecord, rig: Rig | None) -> Rig | None:
    """Return a rig in the unit of a tile; one that the tile itself knows is in that already."""
    if rig is None or isinstance(rig, str):
        return rig
    unit = tile.set_from_tile.similarity.inverse().scale
    return {
        name: replace(sensor, cam_from_rig=scaled_device(sensor.cam_from_rig, unit))
        for name, sensor in rig.items()
    }


def with_queries(images: Sequence[ImageJob], queries: Sequence[Query]) -> tuple[ImageJob, ...]:
    """Return images that were read."""
    return tuple(replace(image, query=query) for image, query in zip(images, queries, strict=True))


def _judged(
    outline: SetOutline, found: Sequence[tuple[int, AnyLocalization]]
) -> tuple[int, AnyLocalization]:
    answers = [Found(row, each.answer) for row, each in found]
    verdict = judge(outline, answers)
    if not isinstance(verdict, Refusal):
        return found[verdict]
    # What the refusal shows is that of the tile with the most inliers.
    row, best = max(found, key=lambda one: inliers_of(one[1].answer))
    answer = best.answer
    if isinstance(answer, InstantAnswer):
        return row, replace(best, answer=replace(answer, pose=None, refusal=verdict))
    refused = NotLocalized(answer.evidence, verdict.stage, verdict.reason, verdict.message)
    return row, replace(best, answer=refused)
