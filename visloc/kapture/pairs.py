"""Pairs files: which photo goes with which, as kapture and hloc write them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from visloc.errors import refuse
from visloc.kapture.table import Table
from visloc.kapture.text import is_field, plain_name
from visloc.kapture.writer import write_atomically

_HEADER = "# query_image, map_image, score"


class PairRow(NamedTuple):
    """One line.

    Attributes:
        score: higher is better; None where the line has none.
        table: where the line is, for errors.
    """

    first: str
    second: str
    score: float | None
    table: Table


def read_pair_rows(path: Path) -> Iterator[PairRow]:
    """Read lines of two names, and a score or none.

    kapture separates them by commas, hloc by blanks. A line with a comma is kapture's, so its names
    may have blanks. Comments and blank lines are ignored; ``./#1.jpg`` is the photo ``#1.jpg``.
    """
    table = Table(Path(), str(path), None)  # so that errors name the whole path
    for fields in table:
        parts = fields if len(fields) > 1 else fields[0].split()
        if len(parts) not in (2, 3):
            raise table.error("pairs.column_count", got=len(parts))
        score = table.numbers(parts[2:])[0] if len(parts) == 3 else None
        yield PairRow(plain_name(parts[0]), plain_name(parts[1]), score, table)


def check_pair_names(path: Path, names: Iterable[str]) -> None:
    """Refuse names of photos that a pairs file cannot hold, such as those with a comma."""
    for name in names:
        if not is_field(name):
            raise refuse("kapture.field", field=str(path), got=name)


def write_pair_rows(path: Path, rows: Iterable[tuple[str, str, float]]) -> None:
    """Write pairs as kapture has them, scores exactly; a file there is replaced.

    A name that begins with ``#``, as comments do, is written as ``./#``. One that would not be read
    as it is, such as one with a comma, is refused.
    """
    lines = [_HEADER]
    for first, second, score in rows:
        check_pair_names(path, (first, second))
        here = "./" if first.startswith("#") else ""
        lines.append(f"{here}{first}, {second}, {score!r}")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, ("\n".join(lines) + "\n").encode("utf-8"))
