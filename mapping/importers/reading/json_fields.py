"""Values of a JSON file that know where they stand, and which of them were asked for."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

from visloc.errors import VislocError, refuse

LARGEST = 1e15  # of any number: what poses and points are made of must not overflow
_NAMED = 10  # how many fields a note lists

# Whose a file is that has a field at its top, for errors.
_FILES = {
    "root_path": "OpenMVG's, which `mapping import openmvg` reads",
    "frames": "nerfstudio's, which `mapping import nerfstudio` reads",
    "shots": "OpenSfM's, which `mapping import opensfm` reads",
    **dict.fromkeys(
        ("featuresFolders", "matchesFolders"),
        "Meshroom's: aliceVision_exportColmap makes what `mapping import colmap` reads of it",
    ),
}

# By key, those asked for of each object that stood at one place; None for all keys of an object
# or all elements of an array. Places are told apart by keys, not by indices: one entry serves the
# frames of a whole recording.
_Asked = dict[str | None, "_Asked"]


@dataclass(frozen=True, slots=True, eq=False)
class JsonValue:
    """One value of a file.

    Attributes:
        parent: the object or array that holds it; None at the top.
        asked: the fields below it that were asked for, in any object of this place.
    """

    value: Any
    file: Path
    parent: JsonValue | None = None
    key: str | int = ""
    asked: _Asked = field(default_factory=dict, repr=False)

    @property
    def where(self) -> str:
        """Where it stands, such as ``sfm_data.json: views[3].value``."""
        steps: list[str] = []
        at = self
        while at.parent is not None:
            steps.append(f"[{at.key}]" if isinstance(at.key, int) else f".{at.key}")
            at = at.parent
        path = "".join(reversed(steps)).removeprefix(".")
        return f"{self.file}: {path}" if path else str(self.file)

    def error(self, message: str, expected: str | None = None) -> VislocError:
        """Make an error about this value."""
        text = repr(self.value) if isinstance(self.value, bool | int | float | str) else None
        kind = text or ("null" if self.value is None else type(self.value).__name__)
        message += self._whose()
        return refuse("import.json", message, field=self.where, expected=expected, got=kind)

    def _whose(self) -> str:
        """Say which program's a file looks like, if this is its top."""
        top = self.value[0] if isinstance(self.value, list) and self.value else self.value
        if self.parent is not None or not isinstance(top, dict):
            return ""
        return next((f"; the file looks like {of}" for key, of in _FILES.items() if key in top), "")

    def __getitem__(self, key: str) -> JsonValue:
        """Return a field of this object."""
        found = self.get(key)
        if found is None:
            raise refuse("import.json", f"{key!r} is missing{self._whose()}", field=self.where)
        return found

    def get(self, key: str) -> JsonValue | None:
        """Return a field of this object, None without it."""
        if not isinstance(self.value, dict):
            raise self.error("the value is not an object", expected="an object")
        asked = self.asked.setdefault(key, {})
        if key not in self.value:
            return None
        return JsonValue(self.value[key], self.file, self, key, asked)

    def get_set(self, key: str) -> JsonValue | None:
        """Return a field of this object, None without it or where it is null."""
        found = self.get(key)
        return None if found is None or found.value is None else found

    def fields(self) -> Iterator[tuple[str, JsonValue]]:
        """Go through the fields of this object, in the file's order."""
        if not isinstance(self.value, dict):
            raise self.error("the value is not an object", expected="an object")
        asked = self.asked.setdefault(None, {})
        return (
            (key, JsonValue(value, self.file, self, key, asked))
            for key, value in self.value.items()
        )

    def elements(self) -> list[JsonValue]:
        """Return the elements of this array."""
        if not isinstance(self.value, list):
            raise self.error("the value is not an array", expected="an array")
        asked = self.asked.setdefault(None, {})
        return [JsonValue(value, self.file, self, i, asked) for i, value in enumerate(self.value)]

    def number(self) -> float:
        """Return this finite number."""
        if type(self.value) in (int, float):
            try:
                number = float(self.value)
            except OverflowError:
                number = math.inf
            if abs(number) <= LARGEST:  # NaN is not
                return number
        raise self.error("the number is not valid", expected=f"a number within +-{LARGEST:g}")

    def numbers(self, count: int) -> list[float]:
        """Return this array of exactly ``count`` finite numbers."""
        elements = self.elements()
        if len(elements) != count:
            raise self.error(f"the array has {len(elements)} elements", expected=f"{count} numbers")
        return [element.number() for element in elements]

    def integer(self, high: int) -> int:
        """Return this whole number from 0 to ``high``."""
        if type(self.value) is not int or not 0 <= self.value <= high:
            raise self.error("the number is not valid", expected=f"a whole number, 0 to {high}")
        return self.value

    def flag(self) -> bool:
        """Return this true or false."""
        if not isinstance(self.value, bool):
            raise self.error("the value is neither true nor false", expected="true or false")
        return self.value

    def text(self) -> str:
        """Return this text."""
        if not isinstance(self.value, str):
            raise self.error("the value is not a text", expected="a text")
        return self.value


def notes_on_unread(top: JsonValue) -> tuple[str, ...]:
    """Count the fields in a value that nothing has asked for, unless they are null or empty."""
    unread: Counter[str] = Counter()
    stack: list[tuple[Any, _Asked, str]] = [(top.value, top.asked, "")]
    while stack:
        value, asked, place = stack.pop()
        within = asked.get(None)
        if isinstance(value, list) and within is not None:
            stack += [(element, within, f"{place}[]") for element in value]
        elif isinstance(value, dict) and asked:  # else it was taken, or passed over, as a whole
            for key, inner in value.items():
                below = asked.get(key, within)
                shown = key if key.isprintable() and len(key) <= 40 else ascii(key[:40])
                path = f"{place}.{'*' if key not in asked and within is not None else shown}"
                if below is not None:
                    stack.append((inner, below, path))
                elif inner not in (None, [], {}):
                    unread[path.removeprefix(".")] += 1
    if not unread:
        return ()
    some = ", ".join(f"{path} ({count})" for path, count in unread.most_common(_NAMED))
    more = f" and {len(unread) - _NAMED} more kinds" if len(unread) > _NAMED else ""
    return (f"{top.file.name} has fields that are not read: {some}{more}",)


def read_json(path: Path) -> JsonValue:
    """Read a JSON file. Keys that occur twice in an object and NaN are refused."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise refuse("import.missing", field=str(path)) from None
    except OSError as error:
        raise refuse("import.unreadable", field=str(path), got=error.strerror) from error
    return parse_json(data, path)


def parse_json(data: bytes, path: Path) -> JsonValue:
    """Read the content of a JSON file, as ``read_json``."""
    try:
        value = json.loads(data, parse_constant=_not_finite, object_pairs_hook=_unique_keys)
    except (ValueError, RecursionError) as error:  # of the syntax, of the text's coding, of depth
        raise refuse("import.json", field=str(path), got=str(error)) from error
    return JsonValue(value, path)


def _not_finite(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is not a number that JSON has")


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    made = dict(pairs)
    if len(made) != len(pairs):
        seen: set[str] = set()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))  # type: ignore[func-returns-value]
        raise ValueError(f"{twice!r} occurs twice in one object")
    return made
