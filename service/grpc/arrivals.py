"""How long the messages of a gRPC call may take to arrive."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable
from typing import Any

import grpc

from service.errors import too_slow
from service.grpc.calls import Handler, behaviour_of, handler_like
from service.grpc.envelope import Context, Envelope
from service.grpc.reading import Unread, reader_of
from service.settings import SLOWEST_BYTES_PER_S
from visloc.errors import InvalidInput, Overloaded, TimedOut

# Calls whose only message may be large.
_LARGE_MESSAGES = ("Localize", "LocalizeRig")


class TimelyCalls(grpc.aio.ServerInterceptor):  # type: ignore[type-arg]  # generic in the stubs only
    """Ends calls whose messages do not come or cannot be parsed.

    Args:
        envelope: answers the calls that end before their method runs.
        max_message_bytes: of one message. gRPC does not tell how much of a message has arrived,
            so every large one gets the time of the largest: ``grace_s`` plus a second for every
            100 kB.
    """

    def __init__(self, envelope: Envelope, grace_s: float, max_message_bytes: int) -> None:
        self._envelope = envelope
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
        patience_s = self._patience_s if name in _LARGE_MESSAGES else self._silence_s

        async def serve(messages: AsyncIterator[Any], context: Context) -> Any:
            try:
                return await behaviour(_timely(messages, patience_s), context)
            # Before the method's own envelope.
            except (InvalidInput, Overloaded, TimedOut) as error:
                await self._envelope.refuse(name, error, context)

        return handler_like(handler, serve, reader_of(handler.request_deserializer))


async def _timely(messages: AsyncIterator[Any], patience_s: float) -> AsyncGenerator[Any]:
    while True:
        try:
            async with asyncio.timeout(patience_s):
                message = await anext(messages, None)
        except TimeoutError:
            raise too_slow(patience_s, "no message in that time") from None
        if message is None:
            return
        if isinstance(message, Unread):
            message = await message.read()
        yield message
