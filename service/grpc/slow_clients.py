"""Slow gRPC clients: how long a message may take to arrive."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from functools import partial
from typing import Any

import grpc

from service.errors import too_slow
from service.grpc.calls import Handler, behaviour_of, handler_like
from service.grpc.connections import GrpcConnections
from service.grpc.envelope import Context, Envelope
from service.grpc.reading import Unread, reader_of
from service.settings import SLOWEST_BYTES_PER_S
from visloc.errors import InvalidInput, Overloaded, TimedOut

# Calls whose only message may be large.
_LARGE_MESSAGES = ("Localize", "LocalizeRig")

Place = Callable[[], AbstractAsyncContextManager[object]]
"""Makes what one message is waited for in; it raises TimeoutError."""


class TimelyCalls(grpc.aio.ServerInterceptor):  # type: ignore[type-arg]
    """Ends calls whose messages do not come or cannot be parsed.

    Args:
        envelope: answers the calls that end before their method runs.
        connections: learns which connections have calls.
        grace_s: the longest silence within a stream.
        max_message_bytes: of one message. gRPC does not tell how much of a message has arrived,
            so every large one gets the time of the largest: ``grace_s`` plus a second for every
            100 kB.
        max_waiting: calls that wait for a large message at once.
    """

    def __init__(
        self,
        envelope: Envelope,
        connections: GrpcConnections,
        grace_s: float,
        max_message_bytes: int,
        max_waiting: int,
    ) -> None:
        self._envelope = envelope
        self._waiting = Waiting(max_waiting)
        self._connections = connections
        self._patience_s = grace_s + max_message_bytes / SLOWEST_BYTES_PER_S
        self._silence_s = grace_s

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable[Handler]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> Handler:
        """Guard one call."""
        handler: Handler | None = await continuation(handler_call_details)
        if handler is None:
            return handler  # type: ignore[return-value]  # gRPC answers: no such method
        behaviour = behaviour_of(handler)
        name = handler_call_details.method.rpartition("/")[2]
        place: Place
        if name in _LARGE_MESSAGES:
            patience_s = self._patience_s
            place = partial(self._waiting.place, patience_s)
        else:  # soon over by itself
            patience_s = self._silence_s
            place = partial(asyncio.timeout, patience_s)

        async def serve(messages: AsyncIterator[Any], context: Context) -> Any:
            with self._connections.in_use(context.peer()):
                try:
                    return await behaviour(_timely(messages, patience_s, place), context)
                except (
                    InvalidInput,
                    Overloaded,
                    TimedOut,
                ) as error:  # before the method's own envelope
                    await self._envelope.refuse(name, error, context)

        return handler_like(handler, serve, reader_of(handler.request_deserializer))


class Waiting:
    """The calls that wait for a large message, at most ``most``: for more, the longest is given up.

    A message may take minutes, if it is as large as any may be. Without this, calls whose messages
    never come would take all places.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._calls: dict[asyncio.Timeout, None] = {}  # the longest waiting first

    @asynccontextmanager
    async def place(self, patience_s: float) -> AsyncIterator[None]:
        """Wait in the block for one message.

        Raises:
            TimeoutError: when it takes longer than ``patience_s``, or others need the place.
        """
        async with asyncio.timeout(patience_s) as call:
            if len(self._calls) >= self._most:
                longest = next(iter(self._calls))
                del self._calls[longest]
                if not longest.expired():  # else its time was over just now
                    longest.reschedule(asyncio.get_running_loop().time())
            self._calls[call] = None
            try:
                yield
            finally:
                self._calls.pop(call, None)


async def _timely(
    messages: AsyncIterator[Any], patience_s: float, place: Place
) -> AsyncGenerator[Any]:
    while True:
        try:
            async with place():
                message = await anext(messages, None)
        except TimeoutError:
            raise too_slow(patience_s, "no message in that time") from None
        if message is None:
            return
        if isinstance(message, Unread):
            message = await message.read()
        yield message
