"""Landmarks to be drawn: in an order of which every beginning shows the whole map, as bytes."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from visloc.archive.checks import array_rows, is_finite, map_array
from visloc.archive.schema import Manifest
from visloc.errors import refuse

MAGIC = b"VLPT"
FORMAT = 1
HAS_COLORS = 1
# magic, format, landmarks of the map, first row, rows, flags; origin of the map
_HEADER = struct.Struct("<4s5I3d")
_ROW = np.dtype([("position", "<f4", 3), ("rgb", "u1", 3), ("photos", "u1")])
HEADER_BYTES, ROW_BYTES = _HEADER.size, _ROW.itemsize
_LANDMARKS, _COLORS = "landmarks.npy", "landmark_rgb.npy"

# How often cells are halved; the numbers of the finest along three axes fit into 64 bits.
_LEVELS = 21
# Of each axis, landmarks that say how large the scene is. What lies outside may be an outlier.
_INNER_PERCENT = (1, 99)
_MAX_MEASURED = 1_000_000
_BLOCK = 250_000


class DrawnMap(Protocol):
    """What is drawn of a map: of a ``Map``, the landmarks without what localizes."""

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


def read_landmarks(folder: Path, manifest: Manifest) -> NDArray[np.float32]:
    """Read where the landmarks (P, 3) of a map are, whose manifest was read before.

    Raises:
        MapCorrupt: ``map.array``; ``map.range`` where they are not finite, which no map is that
            was verified.
    """
    landmarks = map_array(folder, _LANDMARKS, "<f4", (manifest.counts.landmarks, 3), load=True)
    if not is_finite(landmarks):
        raise refuse("map.range", field=str(folder / _LANDMARKS))
    return landmarks


def read_points(folder: Path, manifest: Manifest, rows: NDArray[np.uint32], first: int) -> bytes:
    """Read landmarks of a map as ``GET /maps/{id}/points`` sends them (docs/api.md).

    Nothing of the map is mapped into memory, or kept open.

    Args:
        folder: the map.
        manifest: of it, read before.
        rows: (k,) of the landmarks, in the order in which they are sent.
        first: place of the first of them in the map's ``detail_order``.

    Raises:
        MapCorrupt: ``map.array``.
    """
    num = manifest.counts.landmarks
    colored = _COLORS in manifest.files
    return _header(manifest, first, len(rows), colored=colored) + _packed(
        array_rows(folder, _LANDMARKS, "<f4", (num, 3), rows),
        array_rows(folder, "landmark_track_length.npy", "<u2", (num,), rows),
        array_rows(folder, _COLORS, "|u1", (num, 3), rows) if colored else None,
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
    # Maps may be large: what is no longer needed goes at once, and what can be changed in place is.
    shuffled = np.arange(num, dtype=np.uint32)
    np.random.default_rng(0).shuffle(shuffled)
    cells = _cells(landmarks)[shuffled]
    # The landmark of a cell is the one that came first in the shuffle. So it is also that of all
    # smaller cells that it is in, and no level takes anything back.
    chosen = np.argsort(cells, kind="stable").astype(np.uint32)
    cells = cells[chosen]
    levels = np.full(num, _LEVELS + 1, np.uint8)  # landmarks that share a finest cell come last
    for level in range(_LEVELS, -1, -1):
        begins = np.ones(len(cells), np.bool_)
        np.not_equal(cells[1:], cells[:-1], out=begins[1:])
        starts = np.flatnonzero(begins)
        chosen = np.minimum.reduceat(chosen, starts)
        levels[chosen] = level
        cells = cells[begins]
        cells >>= np.uint64(3)
        del begins, starts
    del cells, chosen
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
    colors = opened.colors
    return _header(opened.manifest, first, len(rows), colored=colors is not None) + _packed(
        opened.landmarks[rows],
        opened.track_lengths[rows],
        None if colors is None else colors[rows],
    )


def _header(manifest: Manifest, first: int, count: int, *, colored: bool) -> bytes:
    """The 48 bytes before ``count`` rows."""
    flags = HAS_COLORS if colored else 0
    total = manifest.counts.landmarks
    return _HEADER.pack(MAGIC, FORMAT, total, first, count, flags, *manifest.world.origin)


def _packed(
    positions: NDArray[np.float32],
    track_lengths: NDArray[np.uint16],
    colors: NDArray[np.uint8] | None,
) -> bytes:
    """16 bytes of each landmark: x, y, z, colour, number of photos."""
    packed = np.zeros(len(positions), _ROW)
    packed["position"] = positions
    if colors is not None:
        packed["rgb"] = colors
    packed["photos"] = np.minimum(track_lengths, 255)
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
