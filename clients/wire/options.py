"""Options of a query as callers give them: values by name, or texts of the command line."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from visloc.errors import VislocError, refuse
from visloc_api.words.options import KINDS, LocalizeOptions

_MAX_WHOLE = 2**32 - 1  # whole numbers are uint32 on the wire
_EXPECTED = {
    int: f"a whole number from 0 to {_MAX_WHOLE}",
    float: "a finite number",
    tuple: "names of mapping photos, with commas between them on the command line",
    Mapping: "a number for each of some global descriptors, such as densevlad=1,localvlad=2",
}


def checked_options(given: LocalizeOptions | Mapping[str, Any]) -> LocalizeOptions:
    """Return options that can be sent.

    Ranges and words are the server's to tell: a newer one knows more.
    """
    options = given if isinstance(given, LocalizeOptions) else LocalizeOptions.read(dict(given))
    for name, value in options.given().items():
        if not _can_be_sent(value):
            raise _unusable(name, value)
    return options


def options_from_texts(texts: Iterable[str]) -> LocalizeOptions:
    """Parse ``NAME=VALUE``, as the command line has them.

    Weights are ``NAME=NUMBER,...``, photos ``NAME,...``.
    """
    values: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise refuse("options.syntax", field="option", got=text)
        kind = KINDS.get(name, str)
        try:
            values[name] = _PARSERS.get(kind, str)(value)
        except ValueError:
            raise _unusable(name, value) from None
    return checked_options(values)


def _can_be_sent(value: Any) -> bool:
    if isinstance(value, list):
        return len(value) > 0
    if isinstance(value, Mapping):
        return len(value) > 0 and all(map(_can_be_sent, value.values()))
    if isinstance(value, float):
        return math.isfinite(value)
    return not isinstance(value, int) or 0 <= value <= _MAX_WHOLE


def _unusable(name: str, value: object) -> VislocError:
    field = f"options.{name}"
    return refuse(field, field=field, expected=_EXPECTED[KINDS[name]], got=value)


def _weights(text: str) -> dict[str, float]:
    weights: dict[str, float] = {}
    for part in text.split(","):
        name, _, number = part.rpartition("=")
        name = name.strip()
        if not name or name in weights:
            raise ValueError(part)
        weights[name] = float(number)
    return weights


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",")]


_PARSERS: Mapping[type, Callable[[str], Any]] = {
    **{int: int, float: float, tuple: _names},
    Mapping: _weights,
}
