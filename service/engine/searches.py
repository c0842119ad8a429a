"""The searches of one request: in maps, and in what extensions search."""

from __future__ import annotations

from collections.abc import Coroutine, Sequence
from typing import Any, Protocol

from service.engine.catalog import Catalog
from service.engine.instant_tasks import together
from service.engine.sequences import SequenceSearch, check_no_tiles
from service.telemetry.metrics import Metrics
from service.values import Localization, MapFolder, RigJob, SequenceJob
from service.workers.pool import Workers
from visloc.archive.kinds import kind_of_sets
from visloc.errors import NotFound
from visloc.priors import Priors


class Search(Protocol):
    """Searches sets of maps, each named by a map id. Used from one event loop."""

    async def localize(self, job: RigJob, map_set: MapFolder) -> Localization:
        """Localize a photo, or the images of a rig."""

    def sequence(self, start: SequenceJob, map_set: MapFolder) -> SequenceSearch:
        """Begin a sequence."""


class SetSearches:
    """The search of sets, loaded when a request first names one."""

    def __init__(self, catalog: Catalog, workers: Workers, metrics: Metrics) -> None:
        self._parts = catalog, workers, metrics
        self._search: Search | None = None

    def of(self, map_set: MapFolder) -> Search:
        """Return what searches a set."""
        if self._search is None:
            search: Search = kind_of_sets(map_set.ref).search(*self._parts)
            self._search = search
        return self._search


async def answers_of(searches: Sequence[Coroutine[Any, Any, Localization]]) -> list[Localization]:
    """Search maps and sets concurrently; ignore sets without a tile that the priors allow."""

    async def answer_of(search: Coroutine[Any, Any, Localization]) -> Localization | NotFound:
        try:
            return await search
        except NotFound as error:
            if error.code != "set.no_tile":
                raise
            return error

    found = await together(answer_of(search) for search in searches)
    answers = [each for each in found if not isinstance(each, NotFound)]
    nothing = [each for each in found if isinstance(each, NotFound)]
    if not answers:
        raise nothing[0]
    return answers


def parted(
    maps: Sequence[MapFolder], priors: Priors
) -> tuple[tuple[MapFolder, ...], tuple[MapFolder, ...]]:
    """Separate sets from other maps. Priors must not name tiles of the latter, which have none."""
    sets = tuple(each for each in maps if each.is_set)
    alone = tuple(each for each in maps if not each.is_set)
    if alone:
        check_no_tiles(alone, priors)
    return sets, alone
