"""Messages of gRPC from bytes: the event loop parses small ones, a thread those of many values."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass
from functools import partial
from typing import Any, ParamSpec, TypeVar

from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.message import DecodeError

from service.api.parsing import ONE_BY_ONE
from visloc.errors import VislocError, refuse
from visloc_api.words.json_text import check_num_values
from visloc_api.words.message import MAX_INSTANT_VALUES

T = TypeVar("T")
P = ParamSpec("P")

# A message of so many values is counted and parsed within milliseconds. A photo has a few dozen.
_FEW = 2000
# Wire types of protobuf, and the bytes that some of them have.
_VARINT, _FIXED64, _BYTES, _START_GROUP, _END_GROUP, _FIXED32 = range(6)
_FIXED_BYTES = {_FIXED64: 8, _FIXED32: 4, _START_GROUP: 0, _END_GROUP: 0}
# Of a number in a packed field; others take one byte or more.
_NUMBER_BYTES = {FieldDescriptor.TYPE_DOUBLE: 8, FieldDescriptor.TYPE_FLOAT: 4}
# The bytes of the last message of the call, if it had more values.
_many: ContextVar[int | None] = ContextVar("many", default=None)


@dataclass(frozen=True)
class Unread:
    """A message that gRPC received and did not parse.

    gRPC parses messages on the event loop, and would end a call with words of its own when that
    fails.

    Attributes:
        kind: its type; None when values are not counted.
    """

    message: bytes
    parse: Callable[[bytes], Any]
    kind: Descriptor | None

    async def read(self) -> Any:
        """Parse the message."""
        if self.kind is None or num_values(self.message, self.kind, _FEW + 1) <= _FEW:
            _many.set(None)
            return self._parsed()
        _many.set(len(self.message))
        return await ONE_BY_ONE.run(self._counted, len(self.message))

    def _counted(self) -> Any:
        assert self.kind is not None
        values = num_values(self.message, self.kind, MAX_INSTANT_VALUES + 1)
        check_num_values(values, MAX_INSTANT_VALUES)
        return self._parsed()

    def _parsed(self) -> Any:
        try:
            return self.parse(self.message)
        except DecodeError as error:
            raise _malformed(str(error)) from None


def reader_of(parse: Callable[[bytes], Any] | None) -> Callable[[bytes], Any] | None:
    """Return what gRPC calls with each message instead of ``parse``."""
    if parse is None:
        return None
    # Generated code gives the parser of a message's class.
    kind = getattr(parse, "__self__", None)
    return partial(Unread, parse=parse, kind=None if kind is None else kind.DESCRIPTOR)


async def converted(convert: Callable[P, T], *given: P.args, **named: P.kwargs) -> T:
    """Call ``convert`` with the last message of this call, not on the event loop."""
    size, call = _many.get(), partial(convert, *given, **named)
    return await (asyncio.to_thread(call) if size is None else ONE_BY_ONE.run(call, size))


def _malformed(got: str) -> VislocError:
    return refuse(
        "request.malformed",
        "the message does not fit the method",
        expected="a protobuf message as in localization.proto",
        got=got,
    )


def num_values(data: bytes, kind: Descriptor, enough: int) -> int:
    """Count the fields of a message and of the messages in it, and the numbers of packed fields.

    Two bytes make an empty message within a message. It takes 50 bytes and 0.2 microseconds to
    parse, without a pause for other threads: 64 MB would take gigabytes and seconds. Neither gRPC
    nor a proxy bounds that. Counts up to the first malformed byte; the parser reports it.
    """
    count, waiting = 0, [(0, len(data), kind)]
    try:
        while waiting:
            position, end, kind = waiting.pop()
            while position < end and count < enough:
                count += 1
                key, position = _varint(data, position)
                if key & 7 == _VARINT:
                    _, position = _varint(data, position)
                elif key & 7 == _BYTES:
                    size, position = _varint(data, position)
                    field = kind.fields_by_number.get(key >> 3)
                    if field is not None and field.message_type is not None:
                        inner_end = min(end, position + size)
                        waiting.append((position, inner_end, field.message_type))
                    elif field is not None and field.is_packed:
                        count += min(size, end - position) // _NUMBER_BYTES.get(field.type, 1)
                    position += size
                else:
                    position += _FIXED_BYTES[key & 7]
    except (IndexError, KeyError):
        pass
    return count


def _varint(data: bytes, position: int) -> tuple[int, int]:
    """Return a number and the position after it (protobuf's encoding, "Base 128 Varints")."""
    value, shift = 0, 0
    while True:
        byte = data[position]
        position += 1
        value |= (byte & 0x7F) << shift
        shift += 7
        if byte < 0x80 or shift >= 70:
            return value, position
