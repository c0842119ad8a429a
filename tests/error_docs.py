"""Write the tables of error codes in the docs from ``visloc/error_codes.toml``.

A page says which codes it wants, by section, group or code, and gets a table below that line:

    <!-- error codes: api -->

    <!-- end of error codes -->
"""

from __future__ import annotations

import re
from pathlib import Path

from visloc.errors import Entry, catalogue

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
_TABLE = re.compile(
    r"(<!-- error codes: (?P<wanted>.+?) -->\n).*?(<!-- end of error codes -->)", re.DOTALL
)


def pages() -> list[Path]:
    """The pages that have such a table."""
    pages = (*DOCS.rglob("*.md"), *ROOT.glob("visloc_extensions/*/README.md"))
    return [page for page in sorted(pages) if _TABLE.search(page.read_text())]


def codes_wanted(text: str) -> list[str]:
    """The codes that the tables of a page are for."""
    return [code for found in _TABLE.finditer(text) for code in _selected(found["wanted"].split())]


def with_tables(text: str) -> str:
    """The text of a page with its tables made anew."""
    return _TABLE.sub(
        lambda m: m[1] + "\n" + _table(_selected(m["wanted"].split())) + "\n" + m[3], text
    )


def _selected(wanted: list[str]) -> list[str]:
    known = catalogue()
    selected = [
        code
        for code, entry in known.items()
        if {entry.section, code, code.partition(".")[0]} & set(wanted)
    ]
    assert selected, f"no code is selected by {wanted}"
    return selected


def _table(codes: list[str]) -> str:
    rows = [f"| `{code}` | {_kinds(entry)} | {_text(entry)} |\n" for code, entry in _entries(codes)]
    return "".join(["| code | kind | what it says |\n", "|---|---|---|\n", *rows])


def _entries(codes: list[str]) -> list[tuple[str, Entry]]:
    return [(code, catalogue()[code]) for code in codes]


def _kinds(entry: Entry) -> str:
    return ", ".join(kind.__name__ for kind in entry.kinds)


def _text(entry: Entry) -> str:
    text = re.sub(r"{(\w+)[^}]*}", lambda m: f"*{m[1].replace('_', ' ')}*", entry.sentence)
    if entry.expected:
        text += f" (expected {entry.expected})"
    if entry.names:
        text += f". `*` is {entry.names}"
    if entry.note:
        text += f". {entry.note}"
    return text.replace("|", "\\|")


if __name__ == "__main__":
    for each in pages():
        each.write_text(with_tables(each.read_text()))
