"""Cutting a large map into tiles on a grid, and these into a set (README.md)."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapping.maps.editing import content_of, selected
from mapping.methods.pieces import MIN_PHOTOS
from mapping.methods.retrieval_only import refuse_without_landmarks
from mapping.own_test.publishing import refuse_not_accepted
from mapping.stages.publishing import new_version, photo_files
from visloc.archive import Map, MapContent, MapStore, write_map
from visloc.archive.anchoring import link_or_copy
from visloc.archive.checks import read_any_manifest
from visloc.archive.schema import ID_PATTERN, photo_file
from visloc.archive.store import open_published
from visloc.archive.version_rules import checked_name
from visloc.errors import MapCorrupt, NotFound, VislocError, refuse
from visloc.geometry import Similarity
from visloc.localization.map_view.constraints import MapGeometry
from visloc.priors import MAX_TILES
from visloc_extensions.sets.publishing import (
    Progress,
    publish_set,
    refuse_map_of_this_name,
    same_content,
)

_TILE_OF = "a tile of "  # in the notes of a tile, before the map
_MAX_CELLS = 2**31  # along one side


@dataclass(frozen=True, slots=True, eq=False)
class Cut:
    """One tile of a map.

    Attributes:
        cell: its place on the grid, from (0, 0).
        photos: (n,) the photos of the map that it has, those of the overlap among them.
    """

    cell: tuple[int, int]
    photos: NDArray[np.bool_]


def split_map(
    store: MapStore,
    ref: str,
    set_id: str,
    progress: Progress,
    *,
    tile: float,
    overlap: float,
) -> Path:
    """Cut a map into tiles and publish them and their set, all in the frame of the map.

    A tile has the photos of its cell and of a margin around it, the landmarks that these see, and
    the map's own global models. Interrupted, the same call goes on: tiles that are there with the
    same content stay as they are.

    Args:
        store: holds the map; the tiles and the set are published there.
        set_id: id of the set; tiles are called ``<set id>-<i>-<j>``.
        tile: side of a cell in units of the world.

    Returns:
        The folder of the set's version.
    """
    checked_name(set_id, "set")
    opened = open_published(store.folder(ref))
    refuse_without_landmarks(opened)
    refuse_not_accepted(store, opened)  # tiles have no test of their own
    refuse_map_of_this_name(store, set_id, "--set")
    cuts = cut(opened, tile, overlap)
    if len(cuts) > MAX_TILES:
        raise refuse(
            "split.tile",
            "there are too many tiles",
            field="--tile",
            expected=f"a side that makes at most {MAX_TILES} tiles",
            got=f"{len(cuts)} tiles",
        )
    _refuse_other_maps(store, opened.manifest.id, set_id, cuts)
    content, pictures, tiles = content_of(opened), photo_files(opened), []
    source = f"{_TILE_OF}{opened.ref}"
    for number, one in enumerate(cuts, 1):
        part = selected(content, images=one.photos)
        part = replace(part, notes=(*part.notes, source))
        some = [pictures[row] for row in np.flatnonzero(one.photos)] if pictures else []
        published = _publish_tile(store, _tile_id(set_id, one), part, some, source)
        tiles.append((published, Similarity.identity()))
        progress("cutting", number, len(cuts))
    notes = [f"cut from {opened.ref}"]
    if opened.gravity is None:
        notes.append("the map does not know which way is down: it was cut along its x and y")
    return publish_set(store, set_id, tiles, progress, notes=notes)


def cut(opened: Map, tile: float, overlap: float) -> tuple[Cut, ...]:
    """Share the photos of a map out to cells of a grid in the plane across gravity.

    The grid begins at the outermost photos. Cells of fewer than five photos join the nearest cell
    of more, by where the photos of both were taken.

    Args:
        opened: the map; where it does not know down, the plane is that of its x and y.
        tile: side of a cell in units of the world.
        overlap: photos of others that are as near to a cell belong to it too.
    """
    if not (np.isfinite(tile) and tile > 0):
        raise refuse("split.tile", field="--tile", got=tile)
    if not 0 <= overlap <= tile:
        raise refuse(
            "split.overlap",
            field="--overlap",
            expected=f"0 to the side of a tile, {tile:g}",
            got=overlap,
        )
    centers = MapGeometry(opened).centers @ _across(opened.gravity).T
    centers -= centers.min(axis=0)
    if centers.max() > _MAX_CELLS * tile:
        raise _too_small(tile)
    cells, cell_of = np.unique((centers // tile).astype(np.int64), axis=0, return_inverse=True)
    cell_of = cell_of.ravel()
    # A map of photos that see nothing could not be.
    counts = np.bincount(cell_of, weights=np.diff(opened.observation_offsets) > 0)
    middles = np.array([centers[cell_of == cell].mean(axis=0) for cell in range(len(cells))])
    large = np.flatnonzero(counts >= MIN_PHOTOS)
    if len(large) == 0 and len(cells) > 1:
        raise _too_small(tile)
    if len(large) == 0:
        large = np.array([0])
    owner = np.array(
        [
            cell if cell in large else large[_nearest(middles[cell], middles[large])]
            for cell in range(len(cells))
        ]
    )
    cuts = []
    for cell in large:
        own = np.isin(cell_of, np.flatnonzero(owner == cell))
        for part in np.flatnonzero(owner == cell):
            low = cells[part] * tile
            away = np.linalg.norm(centers - np.clip(centers, low, low + tile), axis=1)
            own |= away <= overlap
        i, j = cells[cell].tolist()
        cuts.append(Cut((i, j), own))
    return tuple(cuts)


def _too_small(tile: float) -> VislocError:
    return refuse(
        "split.tile",
        "the tiles are too small",
        field="--tile",
        expected=f"a side with which one cell at least has {MIN_PHOTOS} photos",
        got=tile,
    )


def _across(down: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """Two unit vectors (2, 3) across down; the first as near to an axis of the world as may be."""
    if down is None:
        return np.eye(3)[:2]
    axis = np.eye(3)[int(np.abs(down).argmin())]
    first = axis - (axis @ down) * down
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(first, down)])


def _nearest(point: NDArray[np.float64], others: NDArray[np.float64]) -> int:
    return int(np.linalg.norm(others - point, axis=1).argmin())


def _publish_tile(
    store: MapStore, tile_id: str, content: MapContent, pictures: list[Path], source: str
) -> str:
    """Publish a tile unless a version of it is the same already; return ``id@version``.

    A current version of the same version of the map stays so: it may have been made from the tile
    since, as by an update.
    """
    stays = _is_in_use(store, tile_id, source)
    prefix, created = new_version()
    with store.incoming() as incoming:
        for row, picture in enumerate(pictures):
            target = incoming / photo_file(row)
            target.parent.mkdir(exist_ok=True)
            link_or_copy(picture, target)
        version = write_map(incoming, content, map_id=tile_id, version=prefix, created=created)
        for known in store.versions(tile_id):
            with suppress(MapCorrupt):
                if same_content(store.root / tile_id / known, incoming):
                    if not stays:
                        store.set_current(tile_id, known)
                    return f"{tile_id}@{known}"
        store.publish(incoming, tile_id, version, make_current=not stays)
    return f"{tile_id}@{version}"


def _is_in_use(store: MapStore, tile_id: str, source: str) -> bool:
    """Whether a version of a tile is current that was cut from this version of a map."""
    with suppress(NotFound, MapCorrupt):
        return source in read_any_manifest(store.folder(tile_id)).notes
    return False


def _tile_id(set_id: str, one: Cut) -> str:
    return f"{set_id}-{one.cell[0]}-{one.cell[1]}"


def _refuse_other_maps(store: MapStore, map_id: str, set_id: str, cuts: Sequence[Cut]) -> None:
    """Before the long part: tiles must not take over maps that others made."""
    for one in cuts:
        tile_id = _tile_id(set_id, one)
        if not ID_PATTERN.fullmatch(tile_id):
            raise refuse(
                "map.id",
                "the id of the set is too long for the ids of its tiles",
                field="--set",
                expected="an id short enough for -<i>-<j> to follow, 64 letters in all",
                got=tile_id,
            )
        with suppress(NotFound):
            notes = read_any_manifest(store.folder(tile_id)).notes
            if not any(note.startswith(f"{_TILE_OF}{map_id}@") for note in notes):
                raise refuse("split.map_exists", field="--set", got=tile_id, map_id=map_id)
