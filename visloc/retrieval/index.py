"""Which mapping photos look most like the query."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visloc.retrieval.fusion import gharm


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
    index: Mapping[str, NDArray[np.float32]],
    top_k: int,
    weights: NDArray[np.float64] | None = None,
) -> Retrieved:
    """Rank the photos of a map by fused similarity to a query.

    Args:
        query: unit vector (D,) by global descriptor; a zero vector is similar to nothing.
        index: unit rows (n, D) of the map's photos by the same global descriptors.
        top_k: how many to return; fewer when the map has fewer photos.
        weights: (n,) from 0, never to be returned, to 1; they scale how much better a photo is
            than the worst that may be returned. The scores that are returned stay as they are.
    """
    cosines = np.stack([_cosines(query[name], index[name]) for name in index])
    scores = gharm(cosines)
    candidates = np.arange(len(scores)) if weights is None else np.flatnonzero(weights)
    ranked = scores[candidates]
    if weights is not None and len(candidates):
        ranked = (ranked - ranked.min()) * weights[candidates]
    # A stable sort: of equal scores the earlier photo comes first, on every machine.
    best = candidates[np.argsort(-ranked, kind="stable")[:top_k]]
    return Retrieved(
        images=best,
        scores=scores[best],
        similarities={name: row[best] for name, row in zip(index, cosines, strict=True)},
    )


def _cosines(query: NDArray[np.float32], rows: NDArray[np.float32]) -> NDArray[np.float64]:
    # Unit vectors in float32 can give 1 + 1e-7.
    return np.clip((rows @ query).astype(np.float64), -1.0, 1.0)
