"""Landmarks as bytes, as ``GET /maps/{id}/points`` and the map report send them (docs/api.md)."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from visloc.archive import Manifest, Map
from visloc.archive.checks import array_rows
from visloc.drawing.detail_levels import LANDMARKS_FILE

MAGIC = b"VLPT"
FORMAT = 1
HAS_COLORS = 1
# magic, format, landmarks of the map, first row, rows, flags; origin of the map
_HEADER = struct.Struct("<4s5I3d")
_ROW = np.dtype([("position", "<f4", 3), ("rgb", "u1", 3), ("photos", "u1")])
HEADER_BYTES, ROW_BYTES = _HEADER.size, _ROW.itemsize
_COLORS_FILE = "landmark_rgb.npy"


def read_points(folder: Path, manifest: Manifest, rows: NDArray[np.uint32], first: int) -> bytes:
    """Read and pack landmarks of a map, without mapping its files into memory.

    Args:
        folder: the map's folder.
        manifest: the map's manifest.
        rows: (k,) rows of the landmarks, in the order in which they are sent.
        first: position of the first of them in the map's ``detail_order``.
    """
    num = manifest.counts.landmarks
    colored = _COLORS_FILE in manifest.files
    return _header(manifest, first, len(rows), colored=colored) + _packed(
        array_rows(folder, LANDMARKS_FILE, "<f4", (num, 3), rows),
        array_rows(folder, "landmark_track_length.npy", "<u2", (num,), rows),
        array_rows(folder, _COLORS_FILE, "|u1", (num, 3), rows) if colored else None,
    )


def packed_points(opened: Map, order: NDArray[np.uint32], first: int, count: int) -> bytes:
    """Pack landmarks of an open map.

    Args:
        order: its ``detail_order``.
        first: position in the order to begin at; beyond its end, nothing follows the header.
    """
    rows = order[first : first + count]
    colors = opened.colors
    return _header(opened.manifest, first, len(rows), colored=colors is not None) + _packed(
        opened.landmarks[rows],
        opened.track_lengths[rows],
        None if colors is None else colors[rows],
    )


def _header(manifest: Manifest, first: int, count: int, *, colored: bool) -> bytes:
    """The 48 bytes before the rows."""
    flags = HAS_COLORS if colored else 0
    total = manifest.counts.landmarks
    return _HEADER.pack(MAGIC, FORMAT, total, first, count, flags, *manifest.world.origin)


def _packed(
    positions: NDArray[np.float32],
    track_lengths: NDArray[np.uint16],
    colors: NDArray[np.uint8] | None,
) -> bytes:
    """16 bytes per landmark: x, y, z, colour, number of photos."""
    packed = np.zeros(len(positions), _ROW)
    packed["position"] = positions
    if colors is not None:
        packed["rgb"] = colors
    packed["photos"] = np.minimum(track_lengths, 255)
    return packed.tobytes()
