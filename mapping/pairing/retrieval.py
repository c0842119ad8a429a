"""Photos that look alike: by global descriptors, fused as in localization."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from mapping.pairing.ranking import Candidates, best_of_rows, unite
from mapping.pairing.scene import Pairs, Scene
from mapping.pairing.settings import PairSettings
from visloc.errors import refuse
from visloc.options import DEFAULT_FUSION_PARAMETER
from visloc.retrieval.fusion import equal_weights, gharm

# Similarities held at a time, per descriptor: 32 MiB in float64.
_BLOCK_SIZE = 2**22


def pair_by_retrieval(scene: Scene, settings: PairSettings) -> Pairs:
    """Pair every photo with the ``top_k`` that look most like it.

    The score is the cosine similarity with one global descriptor, and its generalized harmonic
    mean (``visloc.retrieval.fusion.gharm``) with several. Every photo gets its pairs, however low
    their scores: the similarity that indicates a shared view differs between descriptors.
    """
    if not scene.global_descriptors:
        raise refuse("pairs.no_global_descriptors", field="--pairs")
    for name, rows in scene.global_descriptors.items():
        unusable = np.flatnonzero(~np.isfinite(rows).all(axis=1))
        if len(unusable):
            raise refuse("pairs.global_descriptor", field=scene.names[unusable[0]], name=name)
    return unite(_ranked_blocks(list(scene.global_descriptors.values()), settings.top_k))


def _ranked_blocks(tables: list[NDArray[np.float32]], top_k: int) -> Iterator[Candidates]:
    num_photos = len(tables[0])
    step = max(1, _BLOCK_SIZE // max(num_photos, 1))
    for start in range(0, num_photos, step):
        yield most_alike(tables, np.arange(start, min(start + step, num_photos)), top_k)


def most_alike(
    tables: Sequence[NDArray[np.float32]], photos: NDArray[np.int64], top_k: int
) -> Candidates:
    """Return the ``top_k`` of all n photos that look most like each of some (b,), by their rows.

    Args:
        tables: descriptors (n, D) of all photos, unit rows; one table for each kind.
    """
    cosines = np.stack([(rows[photos] @ rows.T).ravel() for rows in tables])
    # Unit vectors in float32 can give 1 + 1e-7.
    cosines = np.clip(cosines.astype(np.float64), -1.0, 1.0)
    scores = gharm(cosines, equal_weights(len(tables)), DEFAULT_FUSION_PARAMETER)
    scores = scores.reshape(len(photos), -1)
    scores[np.arange(len(photos)), photos] = -np.inf  # a photo is no pair with itself
    return best_of_rows(photos, scores, top_k)
