"""Write the default and range of each option in docs/api.md from ``visloc.options``.

What an option means stays as the page says it. An option without a row gets one, to be filled in.
"""

from __future__ import annotations

import re
from dataclasses import Field, fields

from tests.error_docs import DOCS
from visloc.options import LocalizeOptions
from visloc_api.words.options import CHOICES

PAGE = DOCS / "api.md"
_TABLE = re.compile(
    r"(?<=\| option \| default \| range \| meaning \|\n\|---\|---\|---\|---\|\n)(\|.*\n)+"
)
_ROW = re.compile(r"\| `(?P<name>\w+)` \| [^|]* \| (?P<range>[^|]*) \| (?P<meaning>[^|]*) \|")
# Options whose range the page says in words.
_IN_WORDS = ("preset", "photos", "fusion_weights")


def with_table(text: str) -> str:
    """The page with its table of options made anew."""
    return _TABLE.sub(lambda table: _rows(table[0]), text)


def _rows(written: str) -> str:
    rows = {row["name"]: row for row in _ROW.finditer(written)}
    made = []
    for option in fields(LocalizeOptions):
        row = rows.get(option.name)
        span = row["range"] if row and option.name in _IN_WORDS else _range(option)
        meaning = row["meaning"] if row else "?"
        default = option.metadata["default"]
        made.append(f"| `{option.name}` | {default} | {span} | {meaning} |\n")
    return "".join(made)


def _range(option: Field[object]) -> str:
    if option.name in CHOICES:
        return ", ".join(CHOICES[option.name])
    low, high = option.metadata["range"]
    return f"{low:g} to {high:.10g}"


if __name__ == "__main__":
    PAGE.write_text(with_table(PAGE.read_text()))
