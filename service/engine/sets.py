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

from service.engine.catalog import Catalog
from service.engine.gather import together
from service.engine.instant_tasks import solve_rig
from service.engine.set_photos import Places, SetPhotos
from service.telemetry.metrics import Metrics
from service.values import (
    ImageJob,
    InstantLocalization,
    Localization,
    LocalizeJob,
    Near,
    Query,
    Rig,
    RigJob,
    Where,
)
from service.workers import process as worker
from service.workers.judging import AnyLocalization, judged
from service.workers.pool import Workers
from service.workers.process import MapFolder
from visloc.archive import SetOutline, TileRecord
from visloc.archive.places import anchor_rms
from visloc.errors import (
    Conflict,
    InvalidInput,
    MapCorrupt,
    NotFound,
    Unavailable,
    VislocError,
    refuse,
)
from visloc.priors import Priors
from visloc.sets.choosing import (
    TileScore,
    allowed_tiles,
    is_clear,
    plan,
    tiles_near,
)
from visloc.sets.frame import answer_in_set, priors_in_tile, scaled_device
from visloc.types import Localized, LocalizeOptions

T = TypeVar("T")

# Codes that begin so say that a map cannot be had, when nothing is wrong with the map itself.
_OF_A_MAP = ("map.", "maps.")


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """Where to look for what a caller asked of a set.

    Attributes:
        first: rows of the tiles to search.
        rest: those to search when none of the first has a clear answer.
        blind: whether the photos say nothing of where that is.
    """

    first: tuple[int, ...]
    rest: tuple[int, ...]
    blind: bool = False


class SetSearch:
    """Searches sets of maps. Used from one event loop.

    Args:
        catalog: gives the tiles.
        workers: do the work.
        metrics: count the tiles that were searched.
    """

    def __init__(self, catalog: Catalog, workers: Workers, metrics: Metrics) -> None:
        self._catalog, self._workers, self._metrics = catalog, workers, metrics
        self._places = Places(workers.count + 1)

    @property
    def waiting(self) -> int:
        """Photos that nobody has read yet."""
        return self._places.waiting

    def reading(
        self, of: MapFolder, queries: Sequence[Query], options: LocalizeOptions
    ) -> SetPhotos:
        """Make room for photos, within a block ``async with``."""
        return SetPhotos(self._places, self._workers, of, queries, options)

    async def within(self, outline: SetOutline, where: Where) -> NDArray[np.bool_] | None:
        """Tell which tiles (T,) are asked for; None for all."""
        if not isinstance(where, Near):
            return None
        # Of ten thousand tiles, it takes a moment.
        return await asyncio.to_thread(
            tiles_near, outline, where.latitude, where.longitude, where.radius
        )

    async def localize(self, job: LocalizeJob, of: MapFolder) -> Localization:
        """Localize a photo, or its features, in a set.

        Raises:
            InvalidInput: ``priors.*``, and what the tiles' maps raise.
            NotFound: ``set.no_tile`` when the priors allow no tile.
            Unavailable: ``set.tile_unavailable``, ``server.worker_died``.
        """
        outline = self._catalog.set_outline(of)
        allowed = allowed_tiles(outline, job.priors, await self.within(outline, job.maps))

        async def ask(row: int, folder: MapFolder, queries: Sequence[Query]) -> Localization:
            priors = self.priors_in(outline, outline.tiles[row], job.priors)
            asked = replace(job, query=queries[0], priors=priors)
            return await self._workers.run(worker.localize, asked, (folder,), time())

        async with self.reading(of, [job.query], job.options) as photos:
            choice = await self.choose(photos, allowed)
            _, found = await self.search(outline, choice, photos, ask)
            return found

    async def localize_rig(self, job: RigJob, of: MapFolder) -> InstantLocalization:
        """Localize the images of one instant together in a set; errors as of ``localize``."""
        outline = self._catalog.set_outline(of)
        allowed = allowed_tiles(outline, job.priors, await self.within(outline, job.maps))

        async def ask(row: int, folder: MapFolder, queries: Sequence[Query]) -> InstantLocalization:
            tile = outline.tiles[row]
            asked = replace(
                job,
                images=with_queries(job.images, queries),
                rig=rig_in(tile, job.rig),
                priors=self.priors_in(outline, tile, job.priors),
            )
            return await solve_rig(self._workers, asked, (folder,))

        queries = [image.query for image in job.images]
        async with self.reading(of, queries, job.options) as photos:
            choice = await self.choose(photos, allowed)
            _, found = await self.search(outline, choice, photos, ask)
            return found

    async def choose(self, photos: SetPhotos, allowed: NDArray[np.bool_]) -> Choice:
        """Read photos, and say which of the allowed tiles to search.

        Photos of one instant count together: by the sum of what they say of a tile.
        """
        rows = np.flatnonzero(allowed)
        scores: dict[int, float] = defaultdict(float)
        for ranked in await photos.rank(allowed if len(rows) > 1 else None):
            for each in ranked:
                scores[each.tile] += each.score
        best_first = sorted(scores, key=lambda tile: -scores[tile])
        if best_first:
            return Choice(*plan([TileScore(tile, scores[tile]) for tile in best_first]))
        # What shows nothing is told so by any tile.
        return Choice((int(rows[0]),), (), blind=len(rows) > 1 or not photos.seen)

    def priors_in(self, outline: SetOutline, tile: TileRecord, priors: Priors) -> Priors:
        """Say what priors of the set's frame mean in that of a tile."""
        return priors_in_tile(priors, tile.set_from_tile.similarity, outline.gravity)

    async def search(
        self,
        outline: SetOutline,
        choice: Choice,
        photos: SetPhotos,
        ask: Callable[[int, MapFolder, Sequence[Query]], Awaitable[AnyLocalization]],
    ) -> tuple[int, AnyLocalization]:
        """Search tiles, and judge what they say.

        A tile that cannot be asked what is asked, say for a rig that it does not know, does not
        count as long as others answer.

        Args:
            outline: of the set.
            choice: where to look.
            photos: what to look for.
            ask: searches one tile, given by its row, in its own frame.

        Returns:
            The row of a tile, and one answer, in the set's frame.

        Raises:
            Unavailable: ``set.tile_unavailable`` for a tile that cannot be opened, unless another
                one has a clear answer.
            VislocError: what ``ask`` raises of every tile.
        """
        found: list[tuple[int, AnyLocalization]] = []
        missing: list[tuple[TileRecord, VislocError]] = []
        unfit: list[VislocError] = []
        for rows in (choice.first, choice.rest):
            if any(is_clear(each.answer) for _, each in found):
                break
            for row, each in await self._asked(outline, rows, photos, ask):
                if not isinstance(each, VislocError):
                    found.append((row, each))
                elif _says_tile_is_away(each):
                    missing.append((outline.tiles[row], each))
                else:
                    unfit.append(each)
        self._metrics.observe_tiles(len(found))
        if missing and not any(is_clear(each.answer) for _, each in found):
            raise tile_unavailable(*missing[0])
        if not found:
            raise unfit[0]
        chosen, answer = judged([each for _, each in found])
        return found[chosen][0], answer

    async def _asked(
        self,
        outline: SetOutline,
        rows: Sequence[int],
        photos: SetPhotos,
        ask: Callable[[int, MapFolder, Sequence[Query]], Awaitable[AnyLocalization]],
    ) -> list[tuple[int, AnyLocalization | VislocError]]:
        """Search tiles at once; of one that cannot be asked, say why."""
        away = await self._catalog.away([outline.tiles[row].ref for row in rows])
        failed = await photos.aside(self._catalog.fetch(away)) if away else {}

        async def of(row: int) -> tuple[int, AnyLocalization | VislocError]:
            tile = outline.tiles[row]
            if tile.ref in failed:
                return row, failed[tile.ref]
            try:
                async with self._catalog.using((tile.ref,), self._workers) as (folder,):
                    return row, in_set(await ask(row, folder, photos.queries), outline, tile)
            except (InvalidInput, NotFound) as error:
                return row, error
            except (MapCorrupt, Conflict, Unavailable) as error:
                if not _says_tile_is_away(error):
                    raise
                return row, error

        return await together(of(row) for row in rows)


def tile_unavailable(tile: TileRecord, error: VislocError) -> VislocError:
    """``set.tile_unavailable``."""
    return refuse(
        "set.tile_unavailable", field="map", expected=tile.ref, got=error.code, why=error.message
    )


def _says_tile_is_away(error: VislocError) -> bool:
    return isinstance(error, MapCorrupt | Conflict) or error.code.startswith(_OF_A_MAP)


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
        raise refuse(
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
        reach=tile.reach,
        anchor_rms=anchor_rms(outline.manifest.world),
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
