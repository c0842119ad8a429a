"""A set of maps on disk: its manifest, and the coarse index over the photos of all tiles."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from visloc.archive import models
from visloc.archive.checks import (
    check_checksums,
    check_files,
    map_array,
    read_model,
)
from visloc.archive.files import Files
from visloc.archive.index_files import check_lists, index_files, open_index
from visloc.archive.schema import Extent, FingerprintRecord
from visloc.archive.set_outline import SetOutline, read_set_outline
from visloc.archive.set_schema import (
    SET_FORMAT,
    SET_MAJOR,
    SET_MINOR,
    SET_OFFSETS,
    SetManifest,
    SetWorld,
    TileRecord,
)
from visloc.archive.version_rules import refuse_renamed
from visloc.errors import refuse
from visloc.retrieval.inverted import InvertedFile, width_of

_MODEL, _INDEX = "coarse/model.npz", index_files("coarse/photos")
_FILES = (SET_OFFSETS, _MODEL, *_INDEX)
# The arrays that localvlad learns, and what turns its descriptors.
_MODEL_ARRAYS = ("vocabulary", "mean", "axes", "rotation")
_BLOCK_BYTES = 2**24


@dataclass(frozen=True, slots=True, eq=False)
class CoarseIndex:
    """An inverted file of all photos, with a few lists for each tile.

    Attributes:
        model: its arrays, and ``rotation`` (D, W): descriptors times it are the rows of the file.
        offsets: (T + 1,) int64; rows offsets[t]:offsets[t + 1] are the photos of tile t.
        inverted: lists K t to K (t + 1) hold the photos of tile t.
    """

    fingerprint: FingerprintRecord
    model: Mapping[str, NDArray[np.float32]]
    offsets: NDArray[np.int64]
    inverted: InvertedFile

    @property
    def tile_lists(self) -> int:
        """Lists of each tile."""
        return len(self.inverted.sizes) // (len(self.offsets) - 1)


@dataclass(frozen=True, slots=True, eq=False)
class MapSet(SetOutline):
    """One version of a set, open for reading; its tiles are not. Lists are mapped from disk."""

    path: Path
    coarse: CoarseIndex


@dataclass(frozen=True, slots=True, eq=False)
class SetContent:
    """Everything in a set except its id, version and creation time."""

    world: SetWorld
    local_features: FingerprintRecord
    tiles: tuple[TileRecord, ...]
    coarse: CoarseIndex
    notes: tuple[str, ...] = ()


def write_set(folder: Path, content: SetContent, *, set_id: str, version: str, created: str) -> str:
    """Write a set into an empty folder. All files are on disk when this returns.

    Arguments and result are as for ``write_map``.
    """
    files, coarse, tiles = Files(folder), content.coarse, content.tiles
    files.write_array(SET_OFFSETS, "<i8", coarse.offsets)
    files.write_array(_INDEX.centers, "<f4", coarse.inverted.centers)
    files.write_array(_INDEX.sizes, "<i8", coarse.inverted.sizes)
    with coarse.inverted.path.open("rb") as lists:
        files.write_bytes(_INDEX.lists, iter(partial(lists.read, _BLOCK_BYTES), b""))
    files.write_model(_MODEL, coarse.model)
    manifest = {
        "format": SET_FORMAT,
        "format_version": f"{SET_MAJOR}.{SET_MINOR}",
        "id": set_id,
        "created": created,
        "world": content.world.model_dump(mode="json"),
        "local_features": content.local_features.model_dump(mode="json"),
        "tiles": [tile.model_dump(mode="json") for tile in tiles],
        "coarse": {
            "fingerprint": coarse.fingerprint.model_dump(mode="json"),
            "dim": coarse.model["rotation"].shape[0],
            "lists": coarse.tile_lists,
        },
        "counts": {
            "tiles": len(tiles),
            "images": sum(tile.images for tile in tiles),
            "landmarks": sum(tile.landmarks for tile in tiles),
        },
        "notes": list(content.notes),
        "files": files.entries(),
    }
    return files.finish(manifest, version)


def open_set(folder: Path) -> MapSet:
    """Open a set after checking its manifest and the presence and size of its files."""
    outline = read_set_outline(folder)
    manifest = outline.manifest
    check_files(folder, manifest)
    record, num_tiles = manifest.coarse, manifest.counts.tiles
    if record.lists is None:
        raise refuse("set.index", field=str(folder), ref=outline.ref)
    for name in _FILES:
        if name not in manifest.files:
            raise refuse(
                "map.file_missing",
                "the manifest does not list a file that every set has",
                field=name,
            )
    offsets = map_array(folder, SET_OFFSETS, "<i8", (num_tiles + 1,), load=True)
    expected = np.cumsum([0, *(tile.images for tile in manifest.tiles)])
    if not np.array_equal(offsets, expected):
        raise refuse(
            "map.range",
            "the offsets of the tiles do not match the manifest",
            field=str(folder / SET_OFFSETS),
        )
    inverted = open_index(
        folder,
        _INDEX,
        dim=record.dim,
        num_lists=num_tiles * record.lists,
        num_rows=manifest.counts.images,
    )
    if not np.array_equal(inverted.sizes.reshape(num_tiles, -1).sum(axis=1), np.diff(offsets)):
        raise refuse("map.range", field=str(folder / _INDEX.sizes))
    coarse = CoarseIndex(
        fingerprint=record.fingerprint,
        model=_read_coarse_model(folder, manifest),
        offsets=offsets,
        inverted=inverted,
    )
    return MapSet(manifest, outline.photo_boxes, outline.reaches, folder, coarse)


def open_published_set(folder: Path) -> MapSet:
    """Open the set in a folder ``<id>/<version>``."""
    opened = open_set(folder)
    refuse_renamed(opened.manifest, str(folder), folder.parent.name, folder.name)
    return opened


def verify_set(folder: Path) -> MapSet:
    """Open a set and read every byte of it: checksums, then ranges.

    ``MapStore.publish`` checks its tiles.
    """
    opened = open_set(folder)
    check_checksums(folder, opened.manifest)
    check_lists(opened.coarse.inverted)
    if not models.fits(opened.coarse.model, opened.manifest.coarse.dim):
        raise refuse("map.range", field=str(folder / _MODEL))
    return opened


def joined_extent(extents: list[Extent]) -> Extent:
    """Return the bounding box of boxes."""
    low = np.min([extent.min for extent in extents], axis=0)
    high = np.max([extent.max for extent in extents], axis=0)
    return Extent(min=low.tolist(), max=high.tolist())


def _read_coarse_model(folder: Path, manifest: SetManifest) -> dict[str, NDArray[np.float32]]:
    """Read the model and check that its arrays fit each other and the manifest."""
    model = read_model(folder, _MODEL)
    record = manifest.coarse
    shapes = {name: model[name].shape if name in model else () for name in _MODEL_ARRAYS}
    size = math.prod(shapes["vocabulary"])
    expected = {
        "vocabulary": shapes["vocabulary"],
        "mean": (size,),
        "axes": (size, record.dim),
        "rotation": (record.dim, width_of(record.dim)),
    }
    if len(shapes["vocabulary"]) != 2 or shapes != expected or model.keys() != expected.keys():
        raise refuse(
            "map.array",
            "the arrays of the coarse model do not fit each other or the manifest",
            field=str(folder / _MODEL),
            expected=f"vocabulary (K, d), mean (K d), axes (K d, {record.dim}), rotation "
            f"({record.dim}, {width_of(record.dim)})",
            got=str(shapes),
        )
    return model
