"""kapture's pairs files: which photo to match with which, in text."""

from __future__ import annotations

from array import array
from pathlib import Path

import numpy as np

from mapping.pairing.ranking import unite
from mapping.pairing.scene import Pairs, Scene
from visloc.kapture.table import Table
from visloc.kapture.text import relative_path
from visloc.kapture.writer import write_atomically

_HEADER = "# query_image, map_image, score"


def write_pairs(path: Path, scene: Scene, pairs: Pairs) -> None:
    """Write pairs for ``read_pairs`` and for kapture's own tools; a file there is replaced.

    Numbers are written exactly.
    """
    lines = [_HEADER]
    lines += [
        f"{scene.names[first]}, {scene.names[second]}, {score!r}"
        for (first, second), score in zip(pairs.rows.tolist(), pairs.scores.tolist(), strict=True)
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, ("\n".join(lines) + "\n").encode("utf-8"))


def read_pairs(path: Path, scene: Scene) -> Pairs:
    """Read lines ``name, name`` or ``name, name, score``; a pair without a score has score 1.

    A repeated pair, in either order, counts once with its best score. Comments and blank lines are
    ignored.

    Raises:
        DatasetError: with file and line; ``kapture.unreadable``, ``kapture.encoding``,
            ``pairs.column_count``, ``pairs.unknown_photo``, ``pairs.same_photo`` or
            ``kapture.number`` for a score that is not a finite number.
    """
    row_of = {name: row for row, name in enumerate(scene.names)}
    table = Table(Path(), str(path), None)  # so that errors name the whole path
    first, second, scores = array("q"), array("q"), array("d")
    for fields in table:
        if len(fields) not in (2, 3):
            raise table.error("pairs.column_count", got=len(fields))
        rows = [_row(row_of, name, table) for name in fields[:2]]
        if rows[0] == rows[1]:
            raise table.error("pairs.same_photo", got=fields[0])
        first.append(rows[0])
        second.append(rows[1])
        scores.extend(table.numbers(fields[2:]) or [1.0])
    return unite([(np.array(first), np.array(second), np.array(scores))])


def _row(row_of: dict[str, int], name: str, table: Table) -> int:
    row = row_of.get(name)
    if row is None:
        try:
            row = row_of.get(relative_path(name))  # such as ./a.jpg or a\b.jpg
        except ValueError:
            row = None
    if row is None:
        raise table.error("pairs.unknown_photo", got=name)
    return row
