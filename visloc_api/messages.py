"""Requests and answers in the API's words as messages of gRPC, which have the same fields."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

from google.protobuf.message import Message

MessageT = TypeVar("MessageT", bound=Message)


def filled(message: MessageT, values: Mapping[str, Any]) -> MessageT:
    """Fill a message from the fields of a model with the same fields, and return it."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            _fill_part(getattr(message, name), value)
        elif isinstance(value, Sequence) and not isinstance(value, str | bytes):
            _fill_list(getattr(message, name), value)
        elif value is not None:
            setattr(message, name, value)
    return message


def _fill_part(part: Any, values: Mapping[str, Any]) -> None:
    if isinstance(part, Message):
        part.SetInParent()  # present even if empty
        filled(part, values)
        return
    for name, value in values.items():  # of a map
        if isinstance(value, Mapping):
            filled(part[name], value)
        else:
            part[name] = value


def _fill_list(entries: Any, values: Sequence[Any]) -> None:
    if values and isinstance(values[0], Mapping):
        for value in values:
            filled(entries.add(), value)
    else:
        entries.extend(values)
