"""Landmarks to be drawn: in an order of which every beginning shows the whole map, as bytes."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from visloc.archive.checks import map_array
from visloc.archive.schema import Manifest

MAGIC = b"VLPT"
FORMAT = 1
HAS_COLORS = 1
# magic, format, landmarks of the map, first row, rows, flags; origin of the map
_HEADER = struct.Struct("<4s5I3d")
_ROW = np.dtype([("position", "<f4", 3), ("rgb", "u1", 3), ("photos", "u1")])
HEADER_BYTES, ROW_BYTES = _HEADER.size, _ROW.itemsize

# How often cells are halved; the numbers of the finest along three axes fit into 64 bits.
_LEVELS = 21
# Of each axis, landmarks that say how large the scene is. What lies outside may be an outlier.
_INNER_PERCENT = (1, 99)
_MAX_MEASURED = 1_000_000
_BLOCK = 1_000_000


class DrawnMap(Protocol):
    """What is drawn of a map: a ``Map``, or ``MapPoints``."""

    @property
    def manifest(self) -> Manifest:
        """``manifest.json``."""

    @property
    def landmarks(self) -> NDArray[np.float32]:
        """(P, 3), relative to the manifest's origin."""

    @property
    def track_lengths(self) -> NDArray[np.uint16]:
        """(P,) mapping photos that see each landmark."""

    @property
    def colors(self) -> NDArray[np.uint8] | None:
        """(P, 3) RGB; None when the map has none."""


@dataclass(frozen=True, slots=True, eq=False)
class MapPoints:
    """The landmarks of a map without what localizes, memory-mapped; fields as of ``Map``."""

    manifest: Manifest
    landmarks: NDArray[np.float32]
    track_lengths: NDArray[np.uint16]
    colors: NDArray[np.uint8] | None


def open_points(folder: Path, manifest: Manifest) -> MapPoints:
    """Open the landmarks of a map, whose manifest was read before.

    Raises:
        MapCorrupt: ``map.array``.
    """
    num = manifest.counts.landmarks
    return MapPoints(
        manifest,
        map_array(folder, "landmarks.npy", "<f4", (num, 3)),
        map_array(folder, "landmark_track_length.npy", "<u2", (num,)),
        map_array(folder, "landmark_rgb.npy", "|u1", (num, 3))
        if "landmark_rgb.npy" in manifest.files
        else None,
    )


def detail_order(landmarks: NDArray[np.float32]) -> NDArray[np.uint32]:
    """Order landmarks so that every beginning of the order samples the map evenly in space.

    Cells of an octree over the scene come level by level: one landmark of each cell, then one of
    each cell of half the size that has none yet, and so on, by chance within a level and within a
    cell. Outside of the inner 98 % of the landmarks along each axis, cells grow with the distance,
    so that a few that are far away are seen and yet take little from the rest.

    Args:
        landmarks: (P, 3), finite.

    Returns:
        (P,) a permutation, the same every time.
    """
    num = len(landmarks)
    if num == 0:
        return np.zeros(0, np.uint32)
    shuffled = np.random.default_rng(0).permutation(num).astype(np.uint32)
    cells = _cells(landmarks)[shuffled]
    # The landmark of a cell is the one that came first in the shuffle. So it is also that of all
    # smaller cells that it is in, and no level takes anything back.
    by_cell = np.argsort(cells, kind="stable").astype(np.uint32)
    cells, chosen = cells[by_cell], by_cell
    levels = np.full(num, _LEVELS + 1, np.uint8)  # landmarks that share a finest cell come last
    for level in range(_LEVELS, -1, -1):
        starts = np.flatnonzero(np.r_[True, cells[1:] != cells[:-1]])
        chosen = np.minimum.reduceat(chosen, starts)
        levels[chosen] = level
        cells = cells[starts] >> np.uint64(3)
    return shuffled[np.argsort(levels, kind="stable")]


def packed_points(opened: DrawnMap, order: NDArray[np.uint32], first: int, count: int) -> bytes:
    """Return landmarks as ``GET /maps/{id}/points`` sends them (docs/api.md).

    Args:
        opened: the map.
        order: its ``detail_order``.
        first: place in the order to begin at; from its end on, nothing follows the header.
        count: most landmarks to return.
    """
    rows = order[first : first + count]
    return point_header(opened, first, len(rows)) + point_rows(opened, rows)


def point_header(opened: DrawnMap, first: int, count: int) -> bytes:
    """Return the 48 bytes before ``count`` rows."""
    flags = 0 if opened.colors is None else HAS_COLORS
    manifest = opened.manifest
    total = manifest.counts.landmarks
    return _HEADER.pack(MAGIC, FORMAT, total, first, count, flags, *manifest.world.origin)


def point_rows(opened: DrawnMap, rows: NDArray[np.uint32]) -> bytes:
    """Return 16 bytes of each of these landmarks: x, y, z, colour, number of photos."""
    packed = np.zeros(len(rows), _ROW)
    packed["position"] = opened.landmarks[rows]
    if opened.colors is not None:
        packed["rgb"] = opened.colors[rows]
    packed["photos"] = np.minimum(opened.track_lengths[rows], 255)
    return packed.tobytes()


def _cells(landmarks: NDArray[np.float32]) -> NDArray[np.uint64]:
    """Number the finest cells so that the leading bits of a number are those of a larger cell."""
    step = -(-len(landmarks) // _MAX_MEASURED)
    inner = np.percentile(landmarks[::step].astype(np.float64), _INNER_PERCENT, axis=0)
    middle = inner.mean(axis=0)
    half = float((inner[1] - inner[0]).max()) / 2
    if half == 0:  # nearly all in one place
        half = float(np.abs(landmarks - middle).max()) or 1.0
    blocks = range(0, len(landmarks), _BLOCK)  # doubles of all of them would be large
    reach = max(float(np.abs(landmarks[b : b + _BLOCK] - middle).max()) for b in blocks) / half
    edge = max(1.0, float(_drawn_nearer(np.array(reach))))
    cells = np.empty(len(landmarks), np.uint64)
    for start in blocks:
        block = _drawn_nearer((landmarks[start : start + _BLOCK] - middle) / half)
        along = ((block / edge + 1) * 2.0 ** (_LEVELS - 1)).astype(np.uint64)
        x, y, z = (_spread(axis) for axis in np.minimum(along, 2**_LEVELS - 1).T)
        cells[start : start + _BLOCK] = x << np.uint64(2) | y << np.uint64(1) | z
    return cells


def _drawn_nearer(along: NDArray[np.float64]) -> NDArray[np.float64]:
    """Leave what is within 1 of 0 where it is, and bring the rest nearer: x to 1 + log x."""
    away = np.abs(along)
    return np.where(away <= 1, along, np.copysign(1 + np.log(np.maximum(away, 1)), along))


def _spread(bits: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Put two zeros between the bits of numbers below 2^21 (interleaving, Morton 1966)."""
    for shift, kept in (
        (32, 0x001F00000000FFFF),
        (16, 0x001F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        bits = (bits | bits << np.uint64(shift)) & np.uint64(kept)
    return bits
