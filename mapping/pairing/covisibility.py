"""Photos that see the same points of a known reconstruction."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from mapping.pairing.ranking import Candidates, best_of_each, unite
from mapping.pairing.scene import Pairs, Scene
from mapping.pairing.settings import PairSettings
from visloc.errors import refuse

_PHOTOS_AT_A_TIME = 512


def pair_by_covisibility(scene: Scene, settings: PairSettings) -> Pairs:
    """Pair every photo with the ``top_k`` that share most 3D points with it.

    The score is the number of points that both see. Points seen by two photos count like all
    others; a photo that sees a point twice counts once.
    """
    if len(scene.tracks) == 0:
        raise refuse("pairs.no_tracks", field="--pairs", expected="photos that see known 3D points")
    return unite(_ranked_blocks(scene.tracks, len(scene.names), settings.top_k))


def _ranked_blocks(tracks: NDArray[np.int64], num_photos: int, top_k: int) -> Iterator[Candidates]:
    points, column = np.unique(tracks[:, 0], return_inverse=True)
    sees = csr_array(
        (np.ones(len(tracks), dtype=np.int64), (tracks[:, 1], column)),
        shape=(num_photos, len(points)),
    )
    sees.sum_duplicates()
    sees.data[:] = 1
    seen_by = sees.T.tocsr()
    for start in range(0, num_photos, _PHOTOS_AT_A_TIME):
        shared = (sees[start : start + _PHOTOS_AT_A_TIME] @ seen_by).tocoo()
        photos, others = (axis.astype(np.int64) for axis in shared.coords)
        photos += start
        pair = photos != others
        yield best_of_each(photos[pair], others[pair], shared.data[pair].astype(np.float64), top_k)
