"""Descriptions of maps and sets, and which of them lie in a circle on Earth."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress

from service.values import ServedMap
from visloc.archive import MapOutline, MapStore, SetOutline
from visloc.archive.set_outline import tiles_near
from visloc.errors import MapCorrupt, NotFound, VislocError, refuse
from visloc.options import MAX_MAPS
from visloc.priors import MAX_TILES
from visloc.types import Near

logger = logging.getLogger(__name__)

# Number of descriptions in memory, about 20 kB each; their arrays stay on disk. There are so many
# because every listing describes all tiles of a set.
_MAX_DESCRIBED = MAX_TILES + 1000
# Number of tiles that are opened at the start; requests open the others. A set may have thousands.
_MAX_TILES_AT_START = 100


class Listing:
    """Describes the maps of a store. All methods block, and are safe in several threads.

    Args:
        served_ref: returns ``id@version`` of the served version of a map; None if none is served.
    """

    def __init__(self, store: MapStore, served_ref: Callable[[str], str | None]) -> None:
        self._store, self._served_ref = store, served_ref
        self._described: dict[str, MapOutline | SetOutline] = {}  # by id@version
        self._set_ids = set[str]()  # of the maps that were described as sets

    def describe(self, ref: str) -> ServedMap:
        """Describe ``id``, in the version that is served, or ``id@version``."""
        map_id, at, version = ref.partition("@")
        try:
            current = self._store.current_version(map_id)
        except (NotFound, MapCorrupt):
            current = ""
        if not at:
            served = self._served_ref(map_id)
            version = current if served is None else served.partition("@")[2]
            if not current:
                self._store.current_version(map_id)  # raises the error
        wanted = f"{map_id}@{version}"
        versions = self._store.versions(map_id)
        outline = self._described.get(wanted) if version in versions else None
        if outline is None:
            outline = self._store.outline(wanted)
            while len(self._described) >= _MAX_DESCRIBED:
                self._described.pop(next(iter(self._described)), None)
            self._described[wanted] = outline
        if isinstance(outline, SetOutline):
            self._set_ids.add(map_id)
        else:
            self._set_ids.discard(map_id)
        return ServedMap(outline, version == current, tuple((v, v == current) for v in versions))

    def all(self, near: Near | None) -> list[ServedMap]:
        """Describe all maps that can be opened, or those that reach into a circle, by id."""
        found = []
        for map_id in self._store.ids():
            try:
                served = self.describe(map_id)
            except VislocError as error:
                logger.warning("map %s is not listed: %s", map_id, error)
                continue
            if near is None or _reaches(served.outline, near):
                found.append(served)
        return found

    def forget(self, ref: str) -> None:
        """Drop the description of ``id@version``, which was deleted."""
        self._described.pop(ref, None)

    def searched_near(self, near: Near) -> tuple[str, ...]:
        """Return the ids of the maps to search in a circle, with sets in place of their tiles."""
        sets, alone = self._sets_and_others()
        found = [one.manifest.id for one in sets if _reaches(one, near)]
        for map_id in alone:
            with suppress(VislocError):  # a map that cannot be read has no place
                if _reaches(self.describe(map_id).outline, near):
                    found.append(map_id)
        if not found:
            raise refuse(
                "map.none_near",
                field="near",
                got=f"{near.latitude:g}, {near.longitude:g}, {near.radius:g} m",
            )
        if len(found) > MAX_MAPS:
            raise refuse(
                "request.map",
                "too many maps reach into this circle",
                field="near.radius",
                expected=f"a circle that at most {MAX_MAPS} maps reach into",
                got=f"{len(found)} maps",
            )
        return tuple(sorted(found))

    def opened_at_start(self) -> tuple[str, ...]:
        """Return what to open at the start, in this order.

        The ids of sets come first, then those of maps that are in no set. Tiles come last, as
        ``id@version``, because the versions that a set names need not be current.
        """
        sets, alone = self._sets_and_others()
        tiles = list(dict.fromkeys(tile.ref for one in sets for tile in one.tiles))
        return (*(one.manifest.id for one in sets), *alone, *tiles[:_MAX_TILES_AT_START])

    def _sets_and_others(self) -> tuple[list[SetOutline], list[str]]:
        """Return the sets, and the ids of maps that are in none.

        Known sets come first, so that their tiles, which may be thousands, are not read.
        """
        sets, maps, tiles = list[SetOutline](), list[str](), set[str]()
        for map_id in sorted(self._store.ids(), key=lambda one: one not in self._set_ids):
            if map_id in tiles:
                continue
            try:
                outline = self.describe(map_id).outline
            except VislocError:
                maps.append(map_id)  # opening it reports the error
                continue
            if isinstance(outline, SetOutline):
                sets.append(outline)
                tiles.update(tile.map for tile in outline.tiles)
            else:
                maps.append(map_id)
        return sets, [map_id for map_id in maps if map_id not in tiles]


def _reaches(outline: MapOutline | SetOutline, near: Near) -> bool:
    place = outline.place
    if place is None or place.distance_to(near.latitude, near.longitude) > near.radius:
        return False
    if isinstance(outline, SetOutline):  # its circle spans the gaps between its tiles
        return bool(tiles_near(outline, near.latitude, near.longitude, near.radius).any())
    return True
