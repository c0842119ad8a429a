"""Sets of maps, in the main process: which tiles are searched, and the judged answer.

A worker process decodes a photo once, finds its features, and ranks the tiles that the priors
allow. The best tiles are searched like any map, with those features. Their answers are moved to the
set's frame and judged together.
"""

from __future__ import annotations

import asyncio
from collections import defaultdict
from collections.abc import Awaitable, Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from service.engine.catalog import Catalog
from service.engine.instant_tasks import localize_in, together
from service.telemetry.metrics import Metrics
from service.values import ImageJob, Localization, MapFolder, Query, Rig, RigJob, Where
from service.workers.judging import agree, judged, without_coarse
from service.workers.pool import Workers
from visloc.archive import SetOutline, TileRecord
from visloc.archive.places import anchor_rms, located
from visloc.archive.set_outline import tiles_near
from visloc.errors import (
    Conflict,
    InvalidInput,
    MapCorrupt,
    NotFound,
    Unavailable,
    VislocError,
    refuse,
)
from visloc.options import ReadAs
from visloc.priors import Priors
from visloc.runtime.threads import summed
from visloc.types import Near, Reason, Refusal
from visloc_extensions.sets.choosing import (
    TileScore,
    allowed_tiles,
    is_clear,
    is_doubtful,
    plan,
)
from visloc_extensions.sets.frame import answer_in_set, priors_in_tile, scaled_device
from visloc_extensions.sets.photos import SetPhotos
from visloc_extensions.sets.unheard import hard_to_find, left_open

# Codes of errors of reaching a map, not of the map itself, begin with one of these.
_OF_A_MAP = ("map.", "maps.")

# Searches one tile, given by its row and folder, in the tile's own frame.
AskTile = Callable[[int, MapFolder, Sequence[Query]], Awaitable[Localization]]


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """The tiles to search, by row.

    Attributes:
        first: the best one, and those with a similar score.
        rest: to search if none of the first gives a clear answer.
        allowed: (T,) those that the priors allow.
        blind: whether no photo could rank tiles.
    """

    first: tuple[int, ...]
    rest: tuple[int, ...]
    allowed: NDArray[np.bool_]
    blind: bool = False

    def without(self, rows: Collection[int]) -> NDArray[np.bool_]:
        """Return which tiles (T,) the priors allow, except some."""
        left = self.allowed.copy()
        left[list(rows)] = False
        return left


class SetSearch:
    """Searches sets of maps. Used from one event loop."""

    def __init__(self, catalog: Catalog, workers: Workers, metrics: Metrics) -> None:
        self._catalog, self._workers, self._metrics = catalog, workers, metrics

    def outline(self, map_set: MapFolder) -> SetOutline:
        return self._catalog.set_outline(map_set)

    def photos(self, map_set: MapFolder, job: RigJob) -> SetPhotos:
        """Return the photos of a request."""
        queries = [image.query for image in job.images]
        return SetPhotos(self._workers, map_set, queries, job.options)

    async def within(self, outline: SetOutline, where: Where) -> NDArray[np.bool_] | None:
        """Return which tiles (T,) lie near the place that a request names; None without a place."""
        if not isinstance(where, Near):
            return None
        # With ten thousand tiles, this takes too long for the event loop.
        return await asyncio.to_thread(
            tiles_near, outline, where.latitude, where.longitude, where.radius
        )

    async def localize(self, job: RigJob, map_set: MapFolder) -> Localization:
        """Localize a photo, or the images of a rig, in a set."""
        outline = self._catalog.set_outline(map_set)
        allowed = allowed_tiles(outline, job.priors, await self.within(outline, job.maps))

        async def ask(
            one: RigJob, row: int, folder: MapFolder, queries: Sequence[Query]
        ) -> Localization:
            tile = outline.tiles[row]
            asked = replace(
                one,
                images=with_queries(job.images, queries),
                rig=rig_in(tile, job.rig),
                priors=priors_in(outline, tile, job.priors),
            )
            return await localize_in(self._workers, asked, (folder,))

        photos = self.photos(map_set, job)
        choice = await self.choose(photos, allowed)
        tries_turns = job.rig is None and job.options.read_as is ReadAs.ANY
        if choice.blind or np.count_nonzero(allowed) == 1 or not tries_turns:
            return (await self.search(outline, choice, photos, partial(ask, job)))[1]
        # As it was sent, the photo is searched in all tiles first. Otherwise each tile would
        # look at turns of a photo that shows the next one.
        upright = replace(job, options=replace(job.options, read_as=ReadAs.UPRIGHT))
        _, found = await self.search(outline, choice, photos, partial(ask, upright))
        refused, began = found.answer.refusal, perf_counter()
        if refused is None:
            return found
        choice = await self.choose(photos, allowed, refused)
        if choice.blind:
            return found
        left = replace(job, refused=refused)
        _, turned = await self.search(outline, choice, photos, partial(ask, left))
        if turned.answer.pose is not None or _is_ambiguous(turned):
            return turned
        return _with_turns(found, perf_counter() - began)

    async def choose(
        self,
        photos: SetPhotos,
        allowed: NDArray[np.bool_],
        refused: Refusal | None = None,
    ) -> Choice:
        """Decode photos, and choose among the allowed tiles by the sum of the photos' scores.

        For a photo that was ``refused`` as it was sent, other turns of it choose.
        """
        rows = np.flatnonzero(allowed)
        scores: dict[int, float] = defaultdict(float)
        for ranked in await photos.rank(allowed if len(rows) > 1 else None, refused):
            for each in ranked:
                scores[each.tile] += each.score
        best_first = sorted(scores, key=lambda tile: -scores[tile])
        if best_first:
            first, rest = plan([TileScore(tile, scores[tile]) for tile in best_first])
            return Choice(first, rest, allowed)
        # Any tile can report that a photo shows nothing.
        return Choice((int(rows[0]),), (), allowed, blind=len(rows) > 1 or not photos.any_decoded)

    async def search(
        self,
        outline: SetOutline,
        choice: Choice,
        photos: SetPhotos,
        ask: AskTile,
    ) -> tuple[int, Localization]:
        """Search tiles, and judge their answers.

        A tile that cannot take the query, for example because it does not know the rig, is ignored
        as long as others answer. A doubtful answer is refused as ambiguous if it leaves
        another tile open (``visloc_extensions.sets.unheard``).

        Returns:
            The row of a tile, and its answer in the set's frame.
        """
        found: list[tuple[int, Localization]] = []
        missing: list[tuple[TileRecord, VislocError]] = []
        unfit: list[VislocError] = []
        for rows in _in_turn(outline, choice, found):
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
        row = found[chosen][0]
        elsewhere = choice.without([other for other, each in found if agree(each, answer)])
        places = {other: each.place for other, each in found}
        refusal = left_open(outline, row, places, elsewhere, choice.first)
        if refusal is not None:
            answer = replace(answer, answer=replace(answer.answer, pose=None, refusal=refusal))
        if np.count_nonzero(choice.allowed) > 1:  # also where one of them was searched
            answer = without_coarse(answer)
        return row, answer

    async def _asked(
        self,
        outline: SetOutline,
        rows: Sequence[int],
        photos: SetPhotos,
        ask: AskTile,
    ) -> list[tuple[int, Localization | VislocError]]:
        """Search tiles concurrently; return the error of one that cannot be searched."""
        fetcher = self._catalog.fetcher
        away = await fetcher.away([outline.tiles[row].ref for row in rows])
        failed = await fetcher.fetch(away) if away else {}

        async def search(row: int) -> tuple[int, Localization | VislocError]:
            tile = outline.tiles[row]
            if tile.ref in failed:
                return row, failed[tile.ref]
            try:
                async with self._catalog.using((tile.ref,)) as (folder,):
                    return row, in_set(await ask(row, folder, photos.queries), outline, tile)
            except (InvalidInput, NotFound) as error:
                return row, error
            except (MapCorrupt, Conflict, Unavailable) as error:
                if not _says_tile_is_away(error):
                    raise
                return row, error

        return await together(search(row) for row in rows)


def _in_turn(
    outline: SetOutline, choice: Choice, found: Sequence[tuple[int, Localization]]
) -> Iterator[tuple[int, ...]]:
    """Yield the tiles that are searched together; ``found`` grows meanwhile."""
    yield choice.first
    yield choice.rest
    doubtful = {outline.tiles[row].ref for row, each in found if is_doubtful(each.answer)}
    yield hard_to_find(outline, doubtful, choice.without([row for row, _ in found]))


def _is_ambiguous(found: Localization) -> bool:
    refusal = found.answer.refusal
    return refusal is not None and refusal.reason is Reason.AMBIGUOUS


def _with_turns(found: Localization, seconds: float) -> Localization:
    """Add the time that other turns took."""
    stages = summed(found.answer.seconds, {"turns": seconds})
    return replace(found, answer=replace(found.answer, seconds=stages))


def tile_unavailable(tile: TileRecord, error: VislocError) -> VislocError:
    """Return the error for a tile that cannot be opened."""
    return refuse(
        "set.tile_unavailable", field="map", expected=tile.ref, got=error.code, why=error.message
    )


def _says_tile_is_away(error: VislocError) -> bool:
    return isinstance(error, MapCorrupt | Conflict) or error.code.startswith(_OF_A_MAP)


def in_set(found: Localization, outline: SetOutline, tile: TileRecord) -> Localization:
    """Move a tile's answer to the set's frame, and name the set and the tile in it."""
    moved, debug = tile.set_from_tile.similarity, found.debug
    if debug is not None:
        debug = replace(debug, points=moved.apply(debug.points))
    return replace(
        found,
        answer=answer_in_set(found.answer, moved, outline.ref),
        debug=debug,
        map_id=outline.manifest.id,
        map_version=outline.manifest.version,
        geodetic=outline.geodetic,
        tile=tile.ref,
        reach=tile.reach,
        anchor_rms=anchor_rms(outline.manifest.world),
        metric=outline.manifest.world.metric,
    )


def priors_in(outline: SetOutline, tile: TileRecord, priors: Priors) -> Priors:
    """Move priors from the set's frame to a tile's."""
    priors = located(priors, outline.manifest.world)
    return priors_in_tile(priors, tile.set_from_tile.similarity, outline.gravity)


def rig_in(tile: TileRecord, rig: Rig | None) -> Rig | None:
    """Return a rig in the unit of a tile; a rig that is only named has that unit already."""
    if rig is None or isinstance(rig, str):
        return rig
    unit = tile.set_from_tile.similarity.inverse().scale
    return {
        name: replace(sensor, cam_from_rig=scaled_device(sensor.cam_from_rig, unit))
        for name, sensor in rig.items()
    }


def with_queries(images: Sequence[ImageJob], queries: Sequence[Query]) -> tuple[ImageJob, ...]:
    """Return images with other queries: their photos, decoded."""
    return tuple(replace(image, query=query) for image, query in zip(images, queries, strict=True))
