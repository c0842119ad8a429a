"""Messages of gRPC from bytes: the event loop parses small ones, a thread those of many values."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass
from functools import partial
from typing import Any, ParamSpec, TypeVar

from google.protobuf.descriptor import Descriptor
from google.protobuf.message import DecodeError

from service.api.parsing import ONE_BY_ONE
from service.grpc.wire_format import num_values
from visloc.errors import VislocError, refuse
from visloc_api.words.json_text import check_num_values
from visloc_api.words.message import MAX_INSTANT_VALUES

T = TypeVar("T")
P = ParamSpec("P")

# A message of so many values is counted and parsed within milliseconds. A photo has a few dozen.
_FEW = 2000
# The bytes of the last message of the call, if it had more values.
_many: ContextVar[int | None] = ContextVar("many", default=None)


@dataclass(frozen=True)
class Unread:
    """A message that gRPC received and did not parse.

    gRPC parses messages on the event loop, and would end a call with words of its own when that
    fails.

    Attributes:
        message: as it came.
        parse: reads it.
        kind: its type; None when values are not counted.
    """

    message: bytes
    parse: Callable[[bytes], Any]
    kind: Descriptor | None

    async def read(self) -> Any:
        """Parse the message.

        Raises:
            TooLarge: ``request.too_large`` when it has too many values.
            InvalidInput: ``request.malformed``.
        """
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
