"""What the manifest of a set of maps says: its tiles, and where they lie."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from visloc.archive.checks import read_any_manifest
from visloc.archive.places import circles_of
from visloc.archive.reader import MapOutline, Outline, outline_of
from visloc.archive.set_schema import SetManifest, TileRecord
from visloc.errors import refuse
from visloc.geodesy import ground_distances


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


def tiles_near(
    outline: SetOutline, latitude: float, longitude: float, radius: float
) -> NDArray[np.bool_]:
    """Tell which tiles overlap a circle on Earth (degrees; radius in metres).

    Returns:
        (T,) all False for a set without a place on Earth.
    """
    if outline.geodetic is None:
        return np.zeros(len(outline.tiles), np.bool_)
    boxes = np.array([(tile.extent.min, tile.extent.max) for tile in outline.tiles])
    circles = circles_of(boxes, outline.geodetic)
    away = ground_distances(circles, np.array([latitude, longitude, 0.0]))
    return np.asarray(away <= radius + circles[:, 2])


def _outline(manifest: SetManifest) -> SetOutline:
    boxes = [(tile.photo_extent.min, tile.photo_extent.max) for tile in manifest.tiles]
    reaches = [tile.reach for tile in manifest.tiles]
    return SetOutline(manifest, np.array(boxes), np.array(reaches))
