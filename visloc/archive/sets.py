"""A set of maps on disk: its manifest, and the coarse index over the photos of all tiles."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from visloc.archive import models
from visloc.archive.checks import (
    check_checksums,
    check_files,
    is_finite,
    map_array,
    read_any_manifest,
    read_model,
)
from visloc.archive.reader import MapOutline, Outline, outline_of, verify_map
from visloc.archive.schema import Extent, FingerprintRecord
from visloc.archive.set_schema import (
    SET_FORMAT,
    SET_MAJOR,
    SET_MINOR,
    SetManifest,
    SetWorld,
    TileRecord,
)
from visloc.archive.writer import Files
from visloc.errors import refuse
from visloc.retrieval.rows import GlobalRows

SET_CODES = "coarse/codes.npy"
_OFFSETS, _MODEL = "coarse/offsets.npy", "coarse/model.npz"
_CENTROIDS, _SCALES = "coarse/centroids.npy", "coarse/centroids.scales.npy"
_FILES = (SET_CODES, _OFFSETS, _MODEL, _CENTROIDS, _SCALES)
# The arrays that localvlad learns, and the planes of the codes.
_MODEL_ARRAYS = ("vocabulary", "mean", "axes", "planes")


@dataclass(frozen=True, slots=True, eq=False)
class SetOutline(Outline[SetManifest]):
    """The manifest of a set, and arrays over its T tiles.

    Attributes:
        manifest: ``manifest.json``.
        photo_boxes: (T, 2, 3) bounding boxes of the photos' centres in the set's frame.
        reaches: (T,) how far the photos of each tile see, in the set's unit.
    """

    manifest: SetManifest
    photo_boxes: NDArray[np.float64]
    reaches: NDArray[np.float64]

    @property
    def tiles(self) -> tuple[TileRecord, ...]:
        return self.manifest.tiles

    @property
    def gravity(self) -> NDArray[np.float64] | None:
        """(3,) unit vector that points down in the set's frame; None when unknown."""
        # Not from the anchor: that one of its maps lies on Earth says nothing about the others.
        gravity = self.manifest.world.gravity
        return None if gravity is None else np.array(gravity)


@dataclass(frozen=True, slots=True, eq=False)
class CoarseIndex:
    """A code of a few bytes for every photo, and a few rows for every tile.

    Attributes:
        model: its arrays, and ``planes`` (D, bits): bit b of a photo's code says on which side of
            plane b its descriptor lies.
        codes: (N, bits / 64) uint64, the codes of all photos, tile by tile.
        offsets: (T + 1,) int64; rows offsets[t]:offsets[t + 1] of ``codes`` belong to tile t.
        centroids: (T * C, D), C rows that summarize the photos of each tile.
    """

    fingerprint: FingerprintRecord
    model: Mapping[str, NDArray[np.float32]]
    codes: NDArray[np.uint64]
    offsets: NDArray[np.int64]
    centroids: GlobalRows

    @property
    def bits(self) -> int:
        """Length of a code."""
        return 64 * int(self.codes.shape[1])


@dataclass(frozen=True, slots=True, eq=False)
class MapSet(SetOutline):
    """One version of a set, open for reading; its tiles are not. Codes are mapped from disk."""

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
    scales = coarse.centroids.scales
    if scales is None:
        raise AssertionError("centroids are stored in 8 bits")
    files.write_array(SET_CODES, "<u8", coarse.codes)
    files.write_array(_OFFSETS, "<i8", coarse.offsets)
    files.write_array(_CENTROIDS, "|i1", coarse.centroids.values)
    files.write_array(_SCALES, "<f4", scales)
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
            "dim": coarse.centroids.values.shape[1],
            "bits": coarse.bits,
            "centroids": len(coarse.centroids) // len(tiles),
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


def read_set_outline(folder: Path) -> SetOutline:
    """Read the manifest of a set; its arrays need not be there.

    Raises:
        MapCorrupt: as ``read_manifest``.
        InvalidInput: ``set.is_map`` when it is a map.
    """
    outline = read_any_outline(folder)
    if not isinstance(outline, SetOutline):
        raise refuse("set.is_map", field="map", got=outline.ref)
    return outline


def read_any_outline(folder: Path) -> MapOutline | SetOutline:
    """Read the small files of a map or a set.

    Raises:
        MapCorrupt: with the file that is wrong.
    """
    manifest = read_any_manifest(folder)
    return _outline(manifest) if isinstance(manifest, SetManifest) else outline_of(folder, manifest)


def open_set(folder: Path) -> MapSet:
    """Open a set after checking its manifest and the presence and size of its files.

    Raises:
        MapCorrupt: with the file that is wrong.
        InvalidInput: ``set.is_map``.
    """
    outline = read_set_outline(folder)
    manifest = outline.manifest
    check_files(folder, manifest)
    for name in _FILES:
        if name not in manifest.files:
            raise refuse(
                "map.file_missing",
                "the manifest does not list a file that every set has",
                field=name,
            )
    record, num_tiles = manifest.coarse, manifest.counts.tiles
    num_rows = num_tiles * record.centroids
    offsets = map_array(folder, _OFFSETS, "<i8", (num_tiles + 1,), load=True)
    expected = np.cumsum([0, *(tile.images for tile in manifest.tiles)])
    if not np.array_equal(offsets, expected):
        raise refuse(
            "map.range",
            "the offsets of the tiles do not match the manifest",
            field=str(folder / _OFFSETS),
        )
    coarse = CoarseIndex(
        fingerprint=record.fingerprint,
        model=_read_coarse_model(folder, manifest),
        codes=map_array(folder, SET_CODES, "<u8", (manifest.counts.images, record.bits // 64)),
        offsets=offsets,
        # Read with every query: held in memory.
        centroids=GlobalRows(
            map_array(folder, _CENTROIDS, "|i1", (num_rows, record.dim), load=True),
            map_array(folder, _SCALES, "<f4", (num_rows,), load=True),
        ),
    )
    return MapSet(manifest, outline.photo_boxes, outline.reaches, folder, coarse)


def verify_set(folder: Path) -> MapSet:
    """Open a set and read every byte of it: checksums, then ranges.

    ``MapStore.publish`` checks its tiles.

    Raises:
        MapCorrupt: with the file and what is wrong.
    """
    opened = open_set(folder)
    check_checksums(folder, opened.manifest)
    scales = opened.coarse.centroids.scales
    if scales is None or not is_finite(scales) or scales.min() < 0:
        raise refuse("map.range", field=str(folder / _SCALES))
    if not models.fits(opened.coarse.model, opened.manifest.coarse.dim):
        raise refuse("map.range", field=str(folder / _MODEL))
    return opened


def verify_any(folder: Path) -> MapOutline | SetOutline:
    """Open a map or a set and read every byte of it.

    Raises:
        MapCorrupt: with the file and what is wrong.
    """
    if isinstance(read_any_manifest(folder), SetManifest):
        return verify_set(folder)
    return verify_map(folder)


def joined_extent(extents: list[Extent]) -> Extent:
    """Return the bounding box of boxes."""
    low = np.min([extent.min for extent in extents], axis=0)
    high = np.max([extent.max for extent in extents], axis=0)
    return Extent(min=low.tolist(), max=high.tolist())


def _outline(manifest: SetManifest) -> SetOutline:
    boxes = [(tile.photo_extent.min, tile.photo_extent.max) for tile in manifest.tiles]
    reaches = [tile.reach for tile in manifest.tiles]
    return SetOutline(manifest, np.array(boxes), np.array(reaches))


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
        "planes": (record.dim, record.bits),
    }
    if len(shapes["vocabulary"]) != 2 or shapes != expected or model.keys() != expected.keys():
        raise refuse(
            "map.array",
            "the arrays of the coarse model do not fit each other or the manifest",
            field=str(folder / _MODEL),
            expected=f"vocabulary (K, d), mean (K d), axes (K d, {record.dim}), planes "
            f"({record.dim}, {record.bits})",
            got=str(shapes),
        )
    return model
