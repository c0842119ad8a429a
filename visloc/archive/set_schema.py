"""Schema of a set's manifest (docs/map-format.md): its tiles and where each of them lies."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from visloc.archive.schema import (
    ID_PATTERN,
    Anchor,
    Direction,
    Extent,
    FileEntry,
    FingerprintRecord,
    Record,
    Sha256,
    UnitQuaternion,
    Vector,
)
from visloc.geometry import Pose, Similarity
from visloc.priors import MAX_TILES

SET_FORMAT = "visloc-set"
SET_MAJOR, SET_MINOR = 2, 1
# Sets of all formats have this file, and maps have not.
SET_OFFSETS = "coarse/offsets.npy"
# Scale of a tile. Beyond these, squares and inverses overflow.
MIN_SCALE, MAX_SCALE = 1e-9, 1e9


class SimilarityRecord(Record):
    """``visloc.geometry.Similarity`` as JSON: ``x_set = scale R x_tile + translation``."""

    scale: Annotated[float, Field(ge=MIN_SCALE, le=MAX_SCALE)] = 1.0
    rotation_wxyz: UnitQuaternion = (1.0, 0.0, 0.0, 0.0)
    translation: Vector = (0.0, 0.0, 0.0)

    @staticmethod
    def of(similarity: Similarity) -> SimilarityRecord:
        pose = Pose(similarity.rotation, similarity.translation)
        w, x, y, z = pose.rotation_wxyz.tolist()
        tx, ty, tz = similarity.translation.tolist()
        return SimilarityRecord(
            scale=similarity.scale, rotation_wxyz=(w, x, y, z), translation=(tx, ty, tz)
        )

    @property
    def similarity(self) -> Similarity:
        pose = Pose.from_quaternion(self.rotation_wxyz, self.translation)
        return Similarity(self.scale, pose.rotation, pose.translation)


class TileRecord(Record):
    """One map of a set. Lengths are in the set's frame and unit.

    Attributes:
        map: id of the map.
        set_from_tile: from the map's world to the set's frame.
        extent: bounding box of landmarks and photos, along the set's axes.
        photo_extent: bounding box of the photos' centres, along the set's axes.
        reach: median distance from its photos to the landmarks that they see.
        mistaken_for: refs of the tiles that the set would search, without this one, for more than
            a few of this tile's own photos.
        misses_own_photos: whether more than a few of its own photos were not found where they are
            by its own test: doubtful answers are usual there. False where no test says.
    """

    map: Annotated[str, Field(pattern=rf"^{ID_PATTERN.pattern}$")]
    version: Annotated[str, Field(pattern=rf"^{ID_PATTERN.pattern}$")]
    content_hash: Sha256
    set_from_tile: SimilarityRecord
    extent: Extent
    photo_extent: Extent
    reach: Annotated[float, Field(ge=0)]
    images: Annotated[int, Field(ge=1)]
    landmarks: Annotated[int, Field(ge=0)]
    size_bytes: Annotated[int, Field(ge=0)]
    mistaken_for: Annotated[tuple[str, ...], Field(max_length=MAX_TILES)] = ()
    misses_own_photos: bool = False

    @property
    def ref(self) -> str:
        """``id@version`` of the map."""
        return f"{self.map}@{self.version}"


class CoarseRecord(Record):
    """The coarse index over all photos of all tiles.

    ``lists`` is the number of lists of each tile. Sets of formats before 2.0 have none, but another
    index, which is not read.
    """

    fingerprint: FingerprintRecord
    dim: Annotated[int, Field(ge=1)]
    lists: Annotated[int, Field(ge=1, le=64)] | None = None


class SetWorld(Record):
    """The frame of the set. ``extent`` holds those of all tiles; ``gravity`` points down."""

    metric: bool
    extent: Extent
    anchor: Anchor | None = None
    gravity: Direction | None = None


class SetCounts(Record):
    """Totals over all tiles."""

    tiles: Annotated[int, Field(ge=1, le=MAX_TILES)]
    images: Annotated[int, Field(ge=1)]
    landmarks: Annotated[int, Field(ge=0)]


class SetManifest(Record):
    """``manifest.json`` of a set."""

    format: Literal["visloc-set"]
    format_version: Annotated[str, Field(pattern=r"^[0-9]{1,8}\.[0-9]{1,8}$")]
    id: Annotated[str, Field(pattern=rf"^{ID_PATTERN.pattern}$")]
    version: Annotated[str, Field(pattern=rf"^{ID_PATTERN.pattern}$")]
    created: str
    world: SetWorld
    local_features: FingerprintRecord
    tiles: Annotated[tuple[TileRecord, ...], Field(min_length=1, max_length=MAX_TILES)]
    coarse: CoarseRecord
    counts: SetCounts
    notes: tuple[str, ...] = ()
    content_hash: Sha256
    manifest_hash: Sha256
    files: dict[str, FileEntry]

    @model_validator(mode="after")
    def _counts_its_tiles(self) -> SetManifest:
        images = sum(tile.images for tile in self.tiles)
        landmarks = sum(tile.landmarks for tile in self.tiles)
        if self.counts != SetCounts(tiles=len(self.tiles), images=images, landmarks=landmarks):
            raise ValueError("the counts are not those of the tiles")
        return self

    @model_validator(mode="after")
    def _names_each_tile_once(self) -> SetManifest:
        if len({tile.ref for tile in self.tiles}) < len(self.tiles):
            raise ValueError("a tile is named twice")
        return self

    @model_validator(mode="after")
    def _boxes_are_boxes(self) -> SetManifest:
        low, high = np.array(self.world.extent.min), np.array(self.world.extent.max)
        if not (low <= high).all():
            raise ValueError("the extent of the set ends before it begins")
        for tile in self.tiles:
            for box in (tile.extent, tile.photo_extent):
                if not (np.array(box.min) <= np.array(box.max)).all():
                    raise ValueError(f"a box of {tile.ref} ends before it begins")
            if not ((low <= tile.extent.min).all() and (tile.extent.max <= high).all()):
                raise ValueError(f"{tile.ref} reaches out of the extent of the set")
        return self
