"""Fewer keypoints to find poses with, spread over each photo.

Thousands of keypoints make good landmarks, but a thousand find a photo's pose as well. Adjustments
take most of the time of incremental mapping, and their time grows with the keypoints.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mapping.methods.matching.stages import Matches
from mapping.methods.sparse.model import SfmPhoto
from visloc.geometry import Camera

# Keypoints that take part: of all photos together, and of each at least. Adjusting few photos takes
# little time with all that they have, and each of their links counts.
ALL, MOST = 100_000, 1000
# Pairs with so few matches keep all, because a photo's pose may depend on them. A pair that keeps
# few of many matches gets none back: matches that no third photo shares are more often wrong.
FEW = 200
# The longer side of a photo is divided into so many cells, which have equal parts of them.
_CELLS = 8


def thin(photos: Sequence[SfmPhoto], matches: Sequence[Matches]) -> list[Matches]:
    """Return the pairs with the matches between the best keypoints of both photos.

    Pairs with ``FEW`` matches or fewer stay as they are. The best of a cell are those matched in
    most pairs, which make the longest tracks.
    """
    counts = [np.zeros(len(photo.keypoints), dtype=np.int64) for photo in photos]
    for pair in matches:
        counts[pair.first][pair.rows[:, 0]] += 1
        counts[pair.second][pair.rows[:, 1]] += 1
    most = max(MOST, ALL // max(len(photos), 1))
    kept = [
        _best_of_cells(photo.camera, photo.keypoints, count, most)
        for photo, count in zip(photos, counts, strict=True)
    ]
    thinned = []
    for pair in matches:
        if len(pair.rows) <= FEW:
            thinned.append(pair)
            continue
        both = kept[pair.first][pair.rows[:, 0]] & kept[pair.second][pair.rows[:, 1]]
        thinned.append(Matches(pair.first, pair.second, pair.rows[both]))
    return thinned


def _best_of_cells(
    camera: Camera, keypoints: NDArray[np.float32], counts: NDArray[np.int64], most: int
) -> NDArray[np.bool_]:
    """Return (n,) which ``most`` are kept: the first of all cells, then the second of all, ..."""
    side = max(camera.width, camera.height) / _CELLS
    column, row = np.floor_divide(keypoints.T, side).astype(np.int64)
    cells = row * (_CELLS + 1) + column
    order = np.lexsort((-counts, cells))
    grouped = cells[order]
    rank = np.arange(len(order)) - np.searchsorted(grouped, grouped)
    matched = counts[order] > 0
    order, rank = order[matched], rank[matched]
    best = order[np.lexsort((-counts[order], rank))[:most]]
    kept = np.zeros(len(keypoints), dtype=bool)
    kept[best] = True
    return kept
