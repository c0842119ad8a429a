"""Photos that priors exclude although they look very much like the query."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from visloc.retrieval.fusion import LateFusion
from visloc.retrieval.index import Retrieved, retrieve
from visloc.retrieval.rows import GlobalRows

# Excluded photos among this many most similar ones are matched too: they may show that the priors
# are wrong.
_NUM_PHOTOS = 5


def excluded_photos(
    query: Mapping[str, NDArray[np.float32]],
    index: Mapping[str, GlobalRows],
    retrieved: Retrieved,
    photo_weights: NDArray[np.float64] | None,
    fusion: LateFusion,
) -> NDArray[np.int64]:
    """Return photos (k,) that the priors exclude and that look as much like the query as others.

    On look-alike floors the most similar photo is a coin toss, so a photo need not be the very
    best to count.

    Args:
        query: as for ``retrieve``.
        index: as for ``retrieve``.
        retrieved: the best photos that the priors allow.
        photo_weights: of the priors, 0 for excluded photos; None when there are no priors.
        fusion: as for ``retrieve``.
    """
    if photo_weights is None:
        return np.empty(0, dtype=np.int64)
    # Ranked among all photos: of the excluded ones alone, often none looks like the query, which
    # takes longest to find out. Besides a photo that counts, at most four allowed and four excluded
    # ones are as good.
    everywhere = retrieve(query, index, 2 * _NUM_PHOTOS - 1, fusion=fusion)
    among = np.flatnonzero(photo_weights[everywhere.images] == 0)[:_NUM_PHOTOS]
    if len(among) < _NUM_PHOTOS and _are_better(everywhere, retrieved, fusion).all():
        # More allowed photos than four are as good: they are not in ``retrieved``, because they
        # count little, or because the caller chose others.
        excluded = np.asarray(photo_weights == 0, dtype=np.float64)
        everywhere = retrieve(query, index, _NUM_PHOTOS, excluded, fusion)
        among = np.arange(len(everywhere.images))
    others = Retrieved(
        everywhere.images[among],
        everywhere.scores[among],
        {name: row[among] for name, row in everywhere.similarities.items()},
    )
    return np.asarray(others.images[_are_better(others, retrieved, fusion)])


def _are_better(found: Retrieved, retrieved: Retrieved, fusion: LateFusion) -> NDArray[np.bool_]:
    """Return which of the photos that were found (k,) are better than the fifth retrieved."""
    # Fuse both lists together: scores that are ranks only compare within one ranking.
    both, num = (retrieved.similarities, found.similarities), len(retrieved.images)
    scores = fusion.scores({name: np.concatenate([f[name] for f in both]) for name in both[0]})
    best = np.sort(scores[:num])[::-1][:_NUM_PHOTOS]
    return np.asarray(scores[num:] > best.min(initial=np.inf))
