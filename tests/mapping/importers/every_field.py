"""No field of a file is dropped in silence: without it, or with one more, a file reads otherwise.

Every field of a small complete file is taken out in turn, and an unknown one is put into every
object and every line. What is read then must differ: in its values, in a note, or by an error.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from visloc.errors import VislocError

Read = Callable[[Path], object]
# Lines that tell nothing: blank ones, the mark at the end of a NVM file, kapture's comments.
ENDS = ("", "0")


def objects(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Go through the places of all objects in a value."""
    if isinstance(value, dict):
        yield path
    if not isinstance(value, dict | list):
        return
    for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
        yield from objects(inner, (*path, key))


def at(value: Any, path: tuple[Any, ...]) -> Any:
    for key in path:
        value = value[key]
    return value


def told(read: Read, path: Path) -> str:
    """Return all that reading a file tells: the values with their notes, or the error."""
    try:
        return shown(read(path))
    except VislocError as error:
        return f"{error.code} {error}"


def shown(value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {value.tolist()}"
    if isinstance(value, dict):
        return str({key: shown(inner) for key, inner in value.items()})
    if isinstance(value, tuple | list):
        return str([shown(inner) for inner in value])
    if hasattr(value, "__dataclass_fields__"):
        return str([shown(getattr(value, each.name)) for each in fields(value)])  # type: ignore[arg-type]
    return str(value)


def check_json(read: Read, path: Path, whole: Any) -> None:
    """Take each field of a JSON file out of it, and put one more into each object."""

    def outcome(value: Any) -> str:
        path.write_text(json.dumps(value))
        return told(read, path.parent)

    before = outcome(whole)
    assert "import." not in before
    silent = []
    for place in objects(whole):
        more = copy.deepcopy(whole)
        at(more, place)["unknown_field"] = {"value": 7}
        if "unknown_field" not in outcome(more):
            silent.append((place, "unknown_field"))
        for key in at(whole, place):
            less = copy.deepcopy(whole)
            del at(less, place)[key]
            if outcome(less) == before:
                silent.append((place, key))
    assert silent == []


def check_lines(read: Read, folder: Path, files: Mapping[str, str], comma: str) -> None:
    """Write files of text, then take each field out of each line, and add one to each."""
    for photo in ("a.jpg", "b.jpg"):
        Image.new("L", (64, 48)).save(folder / photo)
    for file, text in files.items():
        (folder / file).parent.mkdir(exist_ok=True)
        (folder / file).write_text(text)
    before = told(read, folder)
    assert "expected" not in before
    silent = []
    for file, text in files.items():
        lines = text.splitlines()
        for number, line in enumerate(lines):
            cells = line.split(comma)
            changed = [comma.join(cells[:i] + cells[i + 1 :]) for i in range(len(cells))]
            for new in (*changed, *([] if line.startswith("#") else [f"{line}{comma}7"])):
                others = "\n".join([*lines[:number], new, *lines[number + 1 :], ""])
                (folder / file).write_text(others)
                if told(read, folder) == before and line not in ENDS:
                    silent.append((file, line, new))
        (folder / file).write_text(f"{text}7\n")
        if told(read, folder) == before:
            silent.append((file, "", "7"))
        (folder / file).write_text(text)
    assert silent == []
