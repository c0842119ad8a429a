"""Ranks the mapping photos by similarity to the query."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visloc.retrieval.fusion import EQUAL_GHARM, LateFusion
from visloc.retrieval.rows import GlobalRows
from visloc.retrieval.shortlist import united

# Maps with more photos have clusters.
MAX_EXACT = 50_000
# Photos that each descriptor proposes in such maps; measured in docs/decisions/0016.
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
    photo_weights: NDArray[np.float64] | None = None,
    fusion: LateFusion = EQUAL_GHARM,
) -> Retrieved:
    """Rank the photos of a map by fused similarity to a query.

    Up to ``MAX_EXACT`` photos are all compared. In larger maps each descriptor proposes the photos
    of the clusters nearest to the query, and all proposals are compared under all descriptors.

    Args:
        query: unit vector (D,) by global descriptor; a zero vector is similar to nothing.
        index: unit rows of the map's photos by global descriptor.
        top_k: number of photos; fewer if the map has fewer.
        photo_weights: (n,) from 0, which excludes a photo, to 1. They scale the distance of a
            score from the lowest one, for ranking only: returned scores are not changed.
        fusion: fuses similarities into scores; it must use at least one of the descriptors.
    """
    index = {name: index[name] for name in fusion.counted(index)}
    compared = _compared(query, index, top_k, photo_weights)
    cosines = {name: rows.cosines(query[name], compared) for name, rows in index.items()}
    scores = fusion.scores(cosines)
    photos = np.arange(len(scores)) if compared is None else compared
    candidates = np.arange(len(scores))
    ranked = scores
    if photo_weights is not None:
        candidates = np.flatnonzero(photo_weights[photos])
        ranked = scores[candidates]
        ranked = (ranked - ranked.min(initial=np.inf)) * photo_weights[photos[candidates]]
    # A stable sort, so that equal scores keep the map's order on every machine.
    best = candidates[np.argsort(-ranked, kind="stable")[:top_k]]
    return Retrieved(
        images=photos[best],
        scores=scores[best],
        similarities={name: row[best] for name, row in cosines.items()},
    )


def _compared(
    query: Mapping[str, NDArray[np.float32]],
    index: Mapping[str, GlobalRows],
    top_k: int,
    photo_weights: NDArray[np.float64] | None,
) -> NDArray[np.int64] | None:
    """The photos to compare with the query, in the order of the map; None for all."""
    clusters = {name: rows.clusters for name, rows in index.items() if rows.clusters is not None}
    if len(clusters) < len(index):
        return None
    allowed = None if photo_weights is None else photo_weights > 0
    if allowed is not None and np.count_nonzero(allowed) <= MAX_EXACT:
        return np.flatnonzero(allowed)
    count = max(_NUM_PROPOSED, _PROPOSED_PER_RESULT * top_k)
    return united([c.nearest(query[name], count, allowed) for name, c in clusters.items()])
