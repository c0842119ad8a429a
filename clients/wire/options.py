"""Options of a query as callers give them: values by name, or texts of the command line."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from visloc.errors import VislocError, refuse
from visloc_api.words.options import KINDS, LocalizeOptions

OptionValue = int | float | str | Mapping[str, float]

# On the wire whole numbers are uint32. Narrower ranges are the server's to tell, and so are the
# words that an option may have: a newer server knows more.
_MAX_WHOLE = 2**32 - 1
_OPTION_KINDS: Mapping[str, type] = {
    name: dict if kind is Mapping else str if issubclass(kind, str) else kind
    for name, kind in KINDS.items()
}
_EXPECTED = {
    int: f"a whole number from 0 to {_MAX_WHOLE}",
    float: "a finite number",
    str: "a text",
    dict: "a number for each of some global descriptors, such as densevlad=1,localvlad=2",
}


def checked_options(given: LocalizeOptions | Mapping[str, Any]) -> LocalizeOptions:
    """Return options that can be sent.

    Raises:
        InvalidInput: ``request.unknown_field`` for another name, ``options.NAME`` for a value that
            cannot be sent.
    """
    options = given.given() if isinstance(given, LocalizeOptions) else given
    for name, value in options.items():
        _check_name(name)
        if value is not None and not _can_be_sent(value, _OPTION_KINDS[name]):
            raise _not_usable(name, value)
    return given if isinstance(given, LocalizeOptions) else LocalizeOptions(**given)


def options_from_texts(texts: Iterable[str]) -> LocalizeOptions:
    """Parse ``NAME=VALUE``, as the command line has them; weights are ``NAME=NUMBER,...``.

    Raises:
        InvalidInput: ``options.syntax``, ``request.unknown_field`` or ``options.NAME``.
    """
    values: dict[str, OptionValue] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise refuse("options.syntax", field="option", got=text)
        _check_name(name)
        try:
            values[name] = _PARSERS[_OPTION_KINDS[name]](value)
        except ValueError:
            raise _not_usable(name, value) from None
    return checked_options(values)


def _check_name(name: str) -> None:
    if name not in _OPTION_KINDS:
        raise refuse(
            "request.unknown_field", field=f"options.{name}", expected=_OPTION_KINDS, got=name
        )


def _weights(text: str) -> dict[str, float]:
    weights: dict[str, float] = {}
    for part in text.split(","):
        name, _, number = part.rpartition("=")
        name = name.strip()
        if not name or name in weights:
            raise ValueError(part)
        weights[name] = float(number)
    return weights


_PARSERS: Mapping[type, Callable[[str], OptionValue]] = {
    int: int,
    float: float,
    str: str,
    dict: _weights,
}


def _can_be_sent(value: object, kind: type) -> bool:
    if isinstance(value, bool):
        return False
    if kind is int:
        return isinstance(value, int) and 0 <= value <= _MAX_WHOLE
    if kind is float:
        return isinstance(value, int | float) and math.isfinite(value)
    if kind is dict:
        return (
            isinstance(value, Mapping)
            and len(value) > 0
            and all(name and _can_be_sent(name, str) for name in value)
            and all(_can_be_sent(weight, float) for weight in value.values())
        )
    return isinstance(value, str) and value.isprintable()


def _not_usable(name: str, value: object) -> VislocError:
    return refuse(
        f"options.{name}",
        field=f"options.{name}",
        expected=_EXPECTED[_OPTION_KINDS[name]],
        got=value,
    )
