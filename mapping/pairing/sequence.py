"""Photos taken by the same camera one after the other."""

from __future__ import annotations

import numpy as np

from mapping.pairing.ranking import best_pairs
from mapping.pairing.scene import Pairs, Scene
from mapping.pairing.settings import PairSettings
from visloc.errors import refuse


def pair_by_sequence(scene: Scene, settings: PairSettings) -> Pairs:
    """Pair every photo with the ``top_k`` nearest in its camera's sequence.

    The photos of a camera are sorted by time, those of one time by row. The (j + 1)-th next one,
    j from 0, scores ``1 - (j + 1) / top_k``. A photo in the middle thus gets half of its pairs on
    either side, one at an end all of them on one side. Only the order counts, not the elapsed time,
    because the unit of timestamps is unknown here. Breaks in the sequence are therefore bridged,
    which costs some matching and no accuracy. Different cameras are not paired.
    """
    sensors = np.unique(np.array(scene.sensors), return_inverse=True)[1]
    order = np.lexsort((scene.timestamps, sensors))  # stable: equal times stay in rows' order
    rows, scores = [], []
    for step in range(1, min(settings.top_k, len(order) - 1) + 1):
        earlier, later = order[:-step], order[step:]
        same = sensors[earlier] == sensors[later]
        if not same.any():
            break
        pairs = np.column_stack([earlier, later])[same]
        rows.append(pairs.astype(np.int64))
        scores.append(np.full(len(pairs), 1.0 - step / settings.top_k))
    if not rows:
        raise refuse("pairs.no_sequence", field="--pairs")
    return best_pairs(np.concatenate(rows), np.concatenate(scores), settings.top_k)
