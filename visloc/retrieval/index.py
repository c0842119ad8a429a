"""Which mapping photos look most like the query."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visloc.retrieval.fusion import gharm
from visloc.retrieval.rows import GlobalRows
from visloc.retrieval.shortlist import united

# Maps of more photos are written with clusters.
MAX_EXACT = 50_000
# Of those, what each descriptor proposes; measured in docs/decisions/0016.
_NUM_PROPOSED = 4000
_PROPOSED_PER_RESULT = 20


@dataclass(frozen=True, slots=True, eq=False)
class Retrieved:
    """The best mapping photos, best first.

    Attributes:
        images: (k,) int64 rows of the map's image table.
        scores: (k,) float64, fused.
        similarities: (k,) float64 cosine similarity by global descriptor.
    """

    images: NDArray[np.int64]
    scores: NDArray[np.float64]
    similarities: Mapping[str, NDArray[np.float64]]


def retrieve(
    query: Mapping[str, NDArray[np.float32]],
    index: Mapping[str, GlobalRows],
    top_k: int,
    weights: NDArray[np.float64] | None = None,
) -> Retrieved:
    """Rank the photos of a map by fused similarity to a query.

    Of up to ``MAX_EXACT`` photos all are compared. Of more, each descriptor proposes those of the
    clusters most like the query, and all that any of them proposes are compared under all.

    Args:
        query: unit vector (D,) by global descriptor; a zero vector is similar to nothing.
        index: unit rows of the map's photos by the same global descriptors.
        top_k: how many to return; fewer when the map has fewer photos.
        weights: (n,) from 0, never to be returned, to 1; they scale how much better a photo is
            than the worst that was compared. The scores that are returned stay as they are.
    """
    compared = _compared(query, index, top_k, weights)
    cosines = np.stack([rows.cosines(query[name], compared) for name, rows in index.items()])
    scores = gharm(cosines)
    photos = np.arange(len(scores)) if compared is None else compared
    candidates = np.arange(len(scores)) if weights is None else np.flatnonzero(weights[photos])
    ranked = scores[candidates]
    if weights is not None and len(candidates):
        ranked = (ranked - ranked.min()) * weights[photos[candidates]]
    # A stable sort: of equal scores the earlier photo comes first, on every machine.
    best = candidates[np.argsort(-ranked, kind="stable")[:top_k]]
    return Retrieved(
        images=photos[best],
        scores=scores[best],
        similarities={name: row[best] for name, row in zip(index, cosines, strict=True)},
    )


def _compared(
    query: Mapping[str, NDArray[np.float32]],
    index: Mapping[str, GlobalRows],
    top_k: int,
    weights: NDArray[np.float64] | None,
) -> NDArray[np.int64] | None:
    """The photos to compare with the query, in the order of the map; None for all."""
    clusters = {name: rows.clusters for name, rows in index.items() if rows.clusters is not None}
    if len(clusters) < len(index):
        return None
    allowed = None if weights is None else weights > 0
    if allowed is not None and np.count_nonzero(allowed) <= MAX_EXACT:
        return np.flatnonzero(allowed)
    count = max(_NUM_PROPOSED, _PROPOSED_PER_RESULT * top_k)
    return united([c.nearest(query[name], count, allowed) for name, c in clusters.items()])
