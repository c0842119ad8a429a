"""Level-of-detail order of landmarks: every prefix samples the whole map evenly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from visloc.archive.checks import is_finite, map_array
from visloc.archive.schema import Manifest
from visloc.errors import refuse

# How often cells are halved; three axes of the finest cell numbers fit into 64 bits.
_LEVELS = 21
# Percentiles of the landmarks along each axis that bound the scene; beyond may be outliers.
_INNER_PERCENT = (1, 99)
_MAX_MEASURED = 1_000_000
_BLOCK = 250_000
LANDMARKS_FILE = "landmarks.npy"


def read_landmarks(folder: Path, manifest: Manifest) -> NDArray[np.float32]:
    """Read the landmarks (P, 3) of a map into memory."""
    landmarks = map_array(folder, LANDMARKS_FILE, "<f4", (manifest.counts.landmarks, 3), load=True)
    if not is_finite(landmarks):
        raise refuse("map.range", field=str(folder / LANDMARKS_FILE))
    return landmarks


def detail_order(landmarks: NDArray[np.float32]) -> NDArray[np.uint32]:
    """Order landmarks so that every prefix of the order samples the map evenly in space.

    The cells of an octree over the scene come level by level: one landmark of each cell, then one
    of each cell of half the size that has none yet, and so on, in random order within a level and
    within a cell. Beyond the inner 98 % of the landmarks along each axis, cells grow with the
    distance, so that a few distant landmarks appear without crowding out the rest.

    Args:
        landmarks: (P, 3), finite.

    Returns:
        (P,) a permutation, the same every time.
    """
    num = len(landmarks)
    if num == 0:
        return np.zeros(0, np.uint32)
    # Maps may be large: arrays are changed in place and deleted as soon as possible.
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
    """Keep coordinates within [-1, 1]; compress those beyond, x to 1 + log x."""
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
