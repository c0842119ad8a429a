"""The best pairs of every photo.

A pair stays when it is among the best of either of its photos. Ranking only one side, such as the
photo whose name comes first, would leave the other with few or no pairs. Equal scores are ranked
by the other photo's row, so that nothing depends on the order in which candidates were found.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from mapping.pairing.scene import Pairs

# One-sided candidates: a photo's row, the other's row, the score; arrays of equal length.
Candidates = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]


def best_of_each(
    photos: NDArray[np.int64],
    others: NDArray[np.int64],
    scores: NDArray[np.float64],
    top_k: int,
) -> Candidates:
    """Keep the ``top_k`` best candidates of every photo."""
    order = np.lexsort((others, -scores, photos))
    grouped = photos[order]
    rank = np.arange(len(order)) - np.searchsorted(grouped, grouped)
    kept = order[rank < top_k]
    return photos[kept], others[kept], scores[kept]


def best_of_rows(photos: NDArray[np.int64], scores: NDArray[np.float64], top_k: int) -> Candidates:
    """Keep the best of a dense table.

    Args:
        photos: (b,) rows of the scene.
        scores: (b, n) of each with every photo of the scene; minus infinity for none.
    """
    last = max(scores.shape[1] - top_k, 0)
    lowest = np.partition(scores, last, axis=1)[:, last, np.newaxis]
    row, other = np.nonzero((scores >= lowest) & (scores > -np.inf))
    return best_of_each(photos[row], other.astype(np.int64), scores[row, other], top_k)


def unite(candidates: Iterable[Candidates]) -> Pairs:
    """Make pairs of one-sided candidates; one that was found twice keeps its better score."""
    parts = list(candidates)
    if not parts:
        return Pairs(np.empty((0, 2), dtype=np.int64), np.empty(0))
    photos, others, scores = (np.concatenate(column) for column in zip(*parts, strict=True))
    low, high = np.minimum(photos, others), np.maximum(photos, others)
    order = np.lexsort((-scores, high, low))
    low, high, scores = low[order], high[order], scores[order]
    new = np.ones(len(order), dtype=bool)
    new[1:] = (low[1:] != low[:-1]) | (high[1:] != high[:-1])
    return Pairs(np.column_stack([low[new], high[new]]), scores[new])


def best_pairs(rows: NDArray[np.int64], scores: NDArray[np.float64], top_k: int) -> Pairs:
    """Keep of unordered pairs (m, 2), each given once, those among the best of either photo."""
    both = np.concatenate([rows, rows[:, ::-1]])
    return unite([best_of_each(both[:, 0], both[:, 1], np.concatenate([scores, scores]), top_k)])
