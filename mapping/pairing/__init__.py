"""Which photos to match with which."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from mapping.pairing.covisibility import pair_by_covisibility
from mapping.pairing.distance import pair_by_distance
from mapping.pairing.exhaustive import pair_exhaustively
from mapping.pairing.files import matched_pairs, read_pairs, write_pairs
from mapping.pairing.frustum import pair_by_frustum
from mapping.pairing.ranking import unite
from mapping.pairing.retrieval import pair_by_retrieval
from mapping.pairing.scene import Pairs, Scene
from mapping.pairing.sequence import pair_by_sequence
from mapping.pairing.settings import PairSettings
from visloc.errors import refuse

Pairing = Callable[[Scene, PairSettings], Pairs]

PAIRINGS: Mapping[str, Pairing] = {
    "retrieval": pair_by_retrieval,
    "distance": pair_by_distance,
    "frustum": pair_by_frustum,
    "covisibility": pair_by_covisibility,
    "sequence": pair_by_sequence,
    "exhaustive": pair_exhaustively,
}
# Pairings that need poses.
POSED_PAIRINGS = frozenset({"distance", "frustum"})


def pair_photos(scene: Scene, names: Sequence[str], settings: PairSettings) -> Pairs:
    """Run one or several pairings, and unite their pairs.

    Scores of different pairings cannot be compared. With one pairing, they are its own; with
    several, the score of a pair is the number of pairings that found it.

    Args:
        names: keys of ``PAIRINGS``; one that is named twice runs once.
        settings: for all of them; each keeps the best ``top_k`` pairs of every photo.
    """
    distinct = list(dict.fromkeys(names))
    unknown = [name for name in distinct if name not in PAIRINGS]
    if unknown or not distinct:
        raise refuse(
            "pairs.unknown",
            "the pairing is unknown" if unknown else "no pairing is named",
            field="--pairs",
            expected=f"one or more of {', '.join(PAIRINGS)}, separated by commas",
            got=", ".join(unknown),
        )
    found = [PAIRINGS[name](scene, settings) for name in distinct]
    if len(found) == 1:
        return found[0]
    united = unite([(pairs.rows[:, 0], pairs.rows[:, 1], pairs.scores) for pairs in found])
    code = united.rows @ [len(scene.names), 1]  # ascending
    counts = np.zeros(len(united))
    for pairs in found:
        counts[np.searchsorted(code, pairs.rows @ [len(scene.names), 1])] += 1
    return Pairs(united.rows, counts)


__all__ = [
    "PAIRINGS",
    "POSED_PAIRINGS",
    "PairSettings",
    "Pairing",
    "Pairs",
    "Scene",
    "matched_pairs",
    "pair_photos",
    "read_pairs",
    "write_pairs",
]
