"""Pairs files of a dataset's photos: which photo to match with which."""

from __future__ import annotations

from array import array
from pathlib import Path

import numpy as np

from mapping.pairing.ranking import unite
from mapping.pairing.scene import Pairs, Scene
from visloc.kapture.matches import MatchFiles
from visloc.kapture.pairs import PairRow, read_pair_rows, write_pair_rows


def write_pairs(path: Path, scene: Scene, pairs: Pairs) -> None:
    """Write pairs for ``read_pairs`` and for kapture's own tools; a file there is replaced.

    Numbers are written exactly.
    """
    listed = zip(pairs.rows.tolist(), pairs.scores.tolist(), strict=True)
    write_pair_rows(
        path,
        ((scene.names[first], scene.names[second], score) for (first, second), score in listed),
    )


def read_pairs(path: Path, scene: Scene) -> Pairs:
    """Read kapture's or hloc's pairs; a pair without a score has score 1.

    A repeated pair, in either order, counts once with its best score.
    """
    row_of = {name: row for row, name in enumerate(scene.names)}
    first, second, scores = array("q"), array("q"), array("d")
    for pair in read_pair_rows(path):
        rows = [_row(row_of, name, pair) for name in pair[:2]]
        if rows[0] == rows[1]:
            raise pair.table.error("pairs.same_photo", got=pair.first)
        first.append(rows[0])
        second.append(rows[1])
        scores.append(1.0 if pair.score is None else pair.score)
    return unite([(np.array(first), np.array(second), np.array(scores))])


def matched_pairs(matches: MatchFiles, scene: Scene) -> Pairs:
    """Return the pairs of the scene's photos that have a file of matches, each with score 1."""
    row_of = {name: row for row, name in enumerate(scene.names)}
    rows = np.array(
        [
            (row_of[first], row_of[second])
            for first, second in matches.pairs()
            if first in row_of and second in row_of and first != second
        ],
        dtype=np.int64,
    ).reshape(-1, 2)
    return unite([(rows[:, 0], rows[:, 1], np.ones(len(rows)))])


def _row(row_of: dict[str, int], name: str, pair: PairRow) -> int:
    row = row_of.get(name)
    if row is None:
        raise pair.table.error("pairs.unknown_photo", got=name)
    return row
