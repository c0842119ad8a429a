"""Tables in docs/results.md: where each stands, and what it says of its run.

A table ``NAME`` begins with the line ``<!-- table NAME -->``, then says when it was measured, and
ends where its rows end.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

_MARK = re.compile(r"^<!-- table (?P<name>[a-z0-9-]+) -->$", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class Measured:
    """A table as it was measured.

    Attributes:
        commit: short hash of what ran, with ``+`` if the files differed from it.
        date: ISO 8601.
        rows: lines of Markdown, the header first.
    """

    commit: str
    date: str
    rows: Sequence[str]


def names_in(page: str) -> list[str]:
    """Return the names of the page's tables, in its order."""
    return [found["name"] for found in _MARK.finditer(page)]


def with_table(page: str, name: str, measured: Measured) -> str:
    """Return the page with a table replaced, and all else as it is.

    Raises:
        KeyError: when the page has no such table.
    """
    for found in _MARK.finditer(page):
        if found["name"] == name:
            end = _end_of_table(page, found.end() + 1)
            stamp = f"Measured on {measured.date} at commit {measured.commit}."
            lines = [stamp, "", *measured.rows]
            return page[: found.end() + 1] + "\n" + "\n".join(lines) + "\n" + page[end:]
    raise KeyError(name)


def _end_of_table(page: str, start: int) -> int:
    """Return where the first table from a place on ends, after its last line."""
    at, inside = start, False
    for line in page[start:].splitlines(keepends=True):
        is_row = line.startswith("|")
        if (inside and not is_row) or line.startswith(("#", "<!--")):
            return at
        inside, at = is_row, at + len(line)
    return at


def joined_rows(outputs: Sequence[tuple[str, str]]) -> list[str]:
    """Join the tables that several runs printed, under the header of the first.

    Args:
        outputs: what stands in the first column, and what a run printed. An empty name adds no
            column.

    Raises:
        ValueError: when a run printed no table, or one with another header.
    """
    rows: list[str] = []
    for name, output in outputs:
        table = [line for line in output.splitlines() if line.startswith("|")]
        if name:
            table = [
                f"| {first} {line}" if row != 1 else f"|---{line}"
                for row, (first, line) in enumerate(
                    zip(["", "", *[name] * (len(table) - 2)], table, strict=False)
                )
            ]
        if len(table) < 3 or (rows and table[:2] != rows[:2]):
            raise ValueError(f"{name or 'the script'} printed no table, or another one: {output}")
        rows += table[2:] if rows else table
    return rows
