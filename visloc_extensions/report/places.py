"""An even sample of what a map knows: small cells of space, and who sees something in them.

Where depth made the landmarks, each photo brings its own of the same corner. What a query can find
again is the corner: landmarks so near each other count as one place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visloc.archive import Map
from visloc.localization.map_view.constraints import Viewpoints

# Side of a cell, of the distance from which photos see: at it, half a degree, some pixels.
_CELL_OF_REACH = 0.01
# Observations that a photo should keep, and all photos together at most.
_PER_PHOTO, _MOST = 300, 20_000_000
_BLOCK = 1_000_000
_PRIMES = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], dtype=np.uint64)


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Some of the cells that hold landmarks, drawn evenly, with all that photos see of them.

    Attributes:
        share: of all cells that were drawn, above 0 to 1: one of these stands for ``1 / share``.
        points: (k, 3) float64, mean of each cell's landmarks, relative to the map's origin.
        of_landmark: (P,) int32, the place of each landmark; -1 where it was not drawn.
        offsets: (n + 1,) int64; rows offsets[i]:offsets[i + 1] are what photo i sees.
        seen: (m,) int64 places.
        landmarks: (m,) int64 landmarks, in the same rows.
    """

    share: float
    points: NDArray[np.float64]
    of_landmark: NDArray[np.int32]
    offsets: NDArray[np.int64]
    seen: NDArray[np.int64]
    landmarks: NDArray[np.int64]

    def rows(self, photos: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows (r,) of what some photos see, and (r,) the photo of each."""
        starts, counts = self.offsets[photos], self.offsets[photos + 1] - self.offsets[photos]
        firsts = np.cumsum(counts) - counts
        rows = np.repeat(starts - firsts, counts) + np.arange(counts.sum())
        return rows, np.repeat(photos, counts)


def sample_places(opened: Map, viewpoints: Viewpoints) -> Places:
    """Draw places of a map; the same ones each time."""
    num_photos, num_landmarks = len(opened.images), len(opened.landmarks)
    kept_per_photo = min(_PER_PHOTO, max(1, _MOST // num_photos))
    typical = float(np.median(np.diff(opened.observation_offsets)))
    share = min(1.0, kept_per_photo / max(typical, 1.0))
    cells = _cells(opened, _CELL_OF_REACH * viewpoints.reach)
    drawn = np.flatnonzero(cells < np.uint64(share * (2**64 - 2**12)))
    _, first, places = np.unique(cells[drawn], return_index=True, return_inverse=True)
    del cells
    of_landmark = np.full(num_landmarks, -1, dtype=np.int32)
    of_landmark[drawn] = places
    counts = np.bincount(places, minlength=len(first))
    points = np.empty((len(first), 3))
    for axis in range(3):
        sums = np.bincount(places, opened.landmarks[drawn, axis], minlength=len(first))
        points[:, axis] = sums / np.maximum(counts, 1)

    offsets, kept = [0], []
    for photo in range(num_photos):
        landmarks = opened.observations(photo)[0]
        kept.append(landmarks[of_landmark[landmarks] >= 0].astype(np.int64))
        offsets.append(offsets[-1] + len(kept[-1]))
    seen = np.concatenate(kept)
    return Places(
        share, points, of_landmark, np.array(offsets), of_landmark[seen].astype(np.int64), seen
    )


def _cells(opened: Map, side: float) -> NDArray[np.uint64]:
    """A number (P,) for each landmark's cell, as if drawn at random."""
    cells = np.empty(len(opened.landmarks), dtype=np.uint64)
    for start in range(0, len(cells), _BLOCK):
        block = opened.landmarks[start : start + _BLOCK].astype(np.float64)
        # Sides of 1e-9 of a map whose photos see nothing would not fit whole numbers.
        steps = np.clip(np.floor(block / side), -(2.0**62), 2.0**62).astype(np.int64)
        mixed = (steps.view(np.uint64) * _PRIMES).sum(axis=1)
        mixed ^= mixed >> np.uint64(29)
        mixed *= _PRIMES[0]
        cells[start : start + _BLOCK] = mixed ^ (mixed >> np.uint64(32))
    return cells
