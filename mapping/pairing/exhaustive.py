"""Every photo with every other."""

from __future__ import annotations

import numpy as np

from mapping.pairing.scene import Pairs, Scene
from mapping.pairing.settings import PairSettings
from visloc.errors import refuse

# 12.5 million pairs: days of matching.
MAX_PHOTOS = 5000


def pair_exhaustively(scene: Scene, settings: PairSettings) -> Pairs:  # noqa: ARG001
    """Pair all photos, whatever ``top_k`` is; every pair scores 1."""
    num_photos = len(scene.names)
    if num_photos > MAX_PHOTOS:
        raise refuse(
            "pairs.too_many_photos",
            field="--pairs",
            expected=f"at most {MAX_PHOTOS} photos",
            got=num_photos,
        )
    rows = np.column_stack(np.triu_indices(num_photos, k=1)).astype(np.int64)
    return Pairs(rows, np.ones(len(rows)))
