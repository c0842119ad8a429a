"""The map on disk: schema, writer, reader, checks and the store (docs/map-format.md)."""

from __future__ import annotations

from visloc.archive.anchoring import write_anchored
from visloc.archive.checks import sha256_of
from visloc.archive.content import GlobalFeatures, Landmarks, MapContent, pose_row
from visloc.archive.kinds import verify_any
from visloc.archive.parts import add_own_test, write_tested
from visloc.archive.places import GeoCircle, circle_of, down_of
from visloc.archive.reader import Map, MapOutline, open_map, verify_map
from visloc.archive.schema import (
    Anchor,
    FingerprintRecord,
    Geodetic,
    ImageRecord,
    Manifest,
    OwnTest,
    World,
)
from visloc.archive.set_outline import SetOutline, read_any_outline, read_set_outline
from visloc.archive.set_schema import SetManifest, SetWorld, SimilarityRecord, TileRecord
from visloc.archive.store import MapStore, open_remote_store
from visloc.archive.writer import write_map

__all__ = [
    "Anchor",
    "FingerprintRecord",
    "GeoCircle",
    "Geodetic",
    "GlobalFeatures",
    "ImageRecord",
    "Landmarks",
    "Manifest",
    "Map",
    "MapContent",
    "MapOutline",
    "MapStore",
    "OwnTest",
    "SetManifest",
    "SetOutline",
    "SetWorld",
    "SimilarityRecord",
    "TileRecord",
    "World",
    "add_own_test",
    "circle_of",
    "down_of",
    "open_map",
    "open_remote_store",
    "pose_row",
    "read_any_outline",
    "read_set_outline",
    "sha256_of",
    "verify_any",
    "verify_map",
    "write_anchored",
    "write_map",
    "write_tested",
]
