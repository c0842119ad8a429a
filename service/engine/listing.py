"""What maps and sets say about themselves, and which of them lie in a circle on Earth."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass

from service.engine.stores import Store
from service.values import Near
from service.workers.process import MapFolder
from visloc.archive import MapOutline, SetOutline
from visloc.archive.set_schema import MAX_TILES
from visloc.errors import MapCorrupt, NotFound, VislocError, refuse
from visloc.sets.choosing import tiles_near

logger = logging.getLogger(__name__)

# Most maps that one request may search.
MAX_MAPS = 16
# Descriptions of so many versions stay in memory, about 20 kB each; their arrays stay on disk. All
# tiles of a set are listed again and again.
_MAX_DESCRIBED = MAX_TILES + 1000
# Tiles of sets that are opened at the start; others are when they are asked for. A set may have
# thousands.
_MAX_TILES_AT_START = 100


@dataclass(frozen=True, slots=True, eq=False)
class ServedMap:
    """A version of a map.

    Attributes:
        outline: what it, or a set of maps, says about itself.
        current: whether it is the one in use.
        versions: all published ones of the map, oldest first, and which is in use.
    """

    outline: MapOutline | SetOutline
    current: bool
    versions: tuple[tuple[str, bool], ...]


class Listing:
    """Describes what a store has. All of it blocks; safe to use from several threads.

    Args:
        store: where the maps are.
        serving: what is served, by map id.
    """

    def __init__(self, store: Store, serving: Mapping[str, MapFolder]) -> None:
        self._store, self._serving = store, serving
        self._described: dict[str, MapOutline | SetOutline] = {}  # by id@version
        self._set_ids = set[str]()  # of the maps that were described as sets

    def describe(self, ref: str) -> ServedMap:
        """Describe ``id``, in the version that is served, or ``id@version``.

        Raises:
            VislocError: what the store raises.
        """
        map_id, at, version = ref.partition("@")
        try:
            current = self._store.current_version(map_id)
        except (NotFound, MapCorrupt):
            current = ""
        if not at:
            served = self._serving.get(map_id)
            version = current if served is None else served.ref.partition("@")[2]
            if not current:
                self._store.current_version(map_id)  # raises what is wrong
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
        """Keep nothing of ``id@version``, which was deleted."""
        self._described.pop(ref, None)

    def searched_near(self, near: Near) -> tuple[str, ...]:
        """Return the ids of the sets and maps to search in a circle: a set instead of its tiles.

        Raises:
            NotFound: ``map.none_near``.
            InvalidInput: ``request.map`` when there are too many.
        """
        sets, alone = self._sets_and_others()
        found = [of.manifest.id for of in sets if _reaches(of, near)]
        for map_id in alone:
            with suppress(VislocError):  # what cannot be read is nowhere
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
        """Say what to open at the start, and in which order.

        Returns:
            The ids of sets and of maps that are in none; then tiles, each ``id@version``, for a
            set names versions, whatever has become current since.
        """
        sets, alone = self._sets_and_others()
        tiles = list(dict.fromkeys(tile.ref for of in sets for tile in of.tiles))
        return (*(of.manifest.id for of in sets), *alone, *tiles[:_MAX_TILES_AT_START])

    def _sets_and_others(self) -> tuple[list[SetOutline], list[str]]:
        """Return the sets, and the ids of maps that are in none.

        What a set names needs no look of its own: once the sets are known, of thousands of tiles
        nothing is read.
        """
        sets, maps, tiles = list[SetOutline](), list[str](), set[str]()
        for map_id in sorted(self._store.ids(), key=lambda one: one not in self._set_ids):
            if map_id in tiles:
                continue
            try:
                outline = self.describe(map_id).outline
            except VislocError:
                maps.append(map_id)  # opening it says what is wrong
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
    if isinstance(outline, SetOutline):  # between its tiles, there is none of it
        return bool(tiles_near(outline, near.latitude, near.longitude, near.radius).any())
    return True
