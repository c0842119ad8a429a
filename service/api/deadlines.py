"""How long a request may take: what the caller asks for, within what the server allows."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import asynccontextmanager
from typing import TypeVar

from visloc.errors import refuse
from visloc_api.words.wire import TIMEOUT_HEADER

T = TypeVar("T")

_MAX_TIMEOUT_CHARS = 32


def timeout_of(header: str | None, limit_s: float) -> float:
    """Return the seconds that a request may take.

    Args:
        header: what the caller asks for; None when it does not say.
        limit_s: the most that the server allows.

    Raises:
        InvalidInput: ``request.timeout`` when it is not a positive number.
    """
    if header is None:
        return limit_s
    try:
        seconds = float(header) if len(header) <= _MAX_TIMEOUT_CHARS else math.nan
    except ValueError:
        seconds = math.nan
    if not seconds > 0:  # NaN fails too
        raise refuse("request.timeout", field=TIMEOUT_HEADER, got=header)
    return min(seconds, limit_s)


@asynccontextmanager
async def within(seconds: float) -> AsyncIterator[None]:
    """Give up what the block waits for when the time is over.

    Raises:
        TimedOut: ``server.deadline``.
    """
    try:
        async with asyncio.timeout(seconds):
            yield
    except TimeoutError:
        raise refuse(
            "server.deadline",
            "the time for the request is over; the server is busy, or the request is large",
            expected=f"an answer within {seconds:g} s",
        ) from None


async def each_within(seconds: float, items: AsyncIterator[T]) -> AsyncGenerator[T]:
    """Give items as they come, each within a time after the one before was taken.

    Raises:
        TimedOut: ``server.deadline``.
    """
    while True:
        async with within(seconds):
            try:
                item = await anext(items)
            except StopAsyncIteration:
                return
        yield item
