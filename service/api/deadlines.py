"""The id of a request, and how long it may take, within what the server allows."""

from __future__ import annotations

import asyncio
import math
import uuid
from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import TypeVar

from visloc.errors import refuse
from visloc_api.words.wire import REQUEST_ID, TIMEOUT_HEADER

T = TypeVar("T")

_MAX_TIMEOUT_CHARS = 32


@dataclass(frozen=True, slots=True)
class TimeLimit:
    """The time that a request may take.

    Attributes:
        is_callers: whether the caller chose it. Missing such a limit says nothing about the server.
    """

    seconds: float
    is_callers: bool = False


def time_limit_of(header: str | None, limit_s: float) -> TimeLimit:
    """Return the time that a request may take.

    Args:
        header: what the caller asks for; None when it does not say.
    """
    if header is None:
        return TimeLimit(limit_s)
    try:
        seconds = float(header) if len(header) <= _MAX_TIMEOUT_CHARS else math.nan
    except ValueError:
        seconds = math.nan
    if not seconds > 0:  # NaN fails too
        raise refuse("request.timeout", field=TIMEOUT_HEADER, got=header)
    return TimeLimit(seconds, is_callers=True) if seconds < limit_s else TimeLimit(limit_s)


@asynccontextmanager
async def within(limit: TimeLimit) -> AsyncIterator[None]:
    """Give up what the block waits for when the time is over."""
    try:
        async with asyncio.timeout(limit.seconds):
            yield
    except TimeoutError:
        raise refuse(
            "request.deadline" if limit.is_callers else "server.deadline",
            "the time for the request is over; the server is busy, or the request is large",
            expected=f"an answer within {limit.seconds:g} s",
        ) from None


async def each_within(limit: TimeLimit, items: AsyncIterator[T]) -> AsyncGenerator[T]:
    """Give items as they come, each within a time after the one before was taken."""
    while True:
        async with within(limit):
            try:
                item = await anext(items)
            except StopAsyncIteration:
                return
        yield item


def request_id(given: str | None) -> str:
    """Return the caller's id when it is short and visible ASCII, else a new one."""
    return given if given and REQUEST_ID.fullmatch(given) else uuid.uuid4().hex
