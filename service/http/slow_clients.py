"""Slow clients: how long a request may take to arrive, and how much may be on its way at once."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable
from contextlib import aclosing, asynccontextmanager
from typing import Any, NamedTuple

import grpc
import h11
from google.protobuf.message import DecodeError
from starlette.requests import Request
from uvicorn.protocols.http.h11_impl import H11Protocol

from service.grpc.calls import Handler, behaviour_of, handler_like
from service.grpc.connections import GrpcConnections
from service.grpc.envelope import Context, Envelope
from service.http.acceptor import Connection, OpenConnections
from visloc.errors import InvalidInput, TimedOut, VislocError, refuse

# Calls whose only message may be large.
_LARGE_MESSAGES = ("Localize", "LocalizeRig")
# Whoever sends or takes less than this, once the grace is over, is let go.
SLOWEST_BYTES_PER_S = 100_000


def http_protocol(grace_s: float, connections: OpenConnections) -> type[H11Protocol]:
    """Return uvicorn's HTTP/1.1, for connections on which somebody is at work.

    A connection is closed when the head of a request is not there after ``grace_s`` seconds;
    when a body that nobody wants, as its request was refused, does not end within that time;
    and when an answer is not taken, with a second more for every 100 kB of it that wait. A body
    that is wanted is ``Arrivals``' business, idle connections are uvicorn's.
    """

    class TimelyProtocol(H11Protocol, Connection):
        _arriving: asyncio.TimerHandle | None = None
        _leaving: asyncio.TimerHandle | None = None

        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            super().connection_made(transport)
            # Writing pauses while a single byte waits. TLS pauses from the bound, not beyond it.
            transport.set_write_buffer_limits(high=int(self.scheme == "https"), low=0)
            self._watch(first=True)

        def data_received(self, data: bytes) -> None:
            super().data_received(data)
            self._watch()

        def on_response_complete(self) -> None:
            super().on_response_complete()
            self._watch()

        def connection_lost(self, exc: Exception | None) -> None:
            super().connection_lost(exc)
            connections.remove(self)
            for timer in (self._arriving, self._leaving):
                if timer is not None:
                    timer.cancel()

        @property
        def is_sending(self) -> bool:
            transport: asyncio.Transport | None = self.transport
            return transport is not None and transport.get_write_buffer_size() > 0

        def abandon(self) -> None:
            transport: asyncio.Transport | None = self.transport
            if transport is not None:
                transport.abort()
            elif self.opening is not None:
                self.opening.cancel()

        def pause_writing(self) -> None:
            super().pause_writing()
            patience_s = grace_s + self.transport.get_write_buffer_size() / SLOWEST_BYTES_PER_S
            # Not closed, which would wait for the client to take the rest.
            self._leaving = self.loop.call_later(patience_s, self.transport.abort)

        def resume_writing(self) -> None:
            super().resume_writing()
            if self._leaving is not None:
                self._leaving.cancel()

        def _watch(self, *, first: bool = False) -> None:
            """Start the clock when it is the client's turn; what it sends does not set it back."""
            in_use = self.cycle is not None and not self.cycle.response_complete
            connections.note(self, in_use=in_use)
            state = self.conn.their_state
            has_part_of_head = state is h11.IDLE and (first or bool(self.conn.trailing_data[0]))
            is_unwanted = state is h11.SEND_BODY and self.conn.our_state is h11.DONE
            if has_part_of_head or is_unwanted:
                self._arriving = self._arriving or self.loop.call_later(
                    grace_s, self.transport.abort
                )
            elif self._arriving is not None:
                self._arriving.cancel()
                self._arriving = None

    return TimelyProtocol


class Arrivals:
    """Bodies of requests over HTTP, while they arrive.

    Args:
        grace_s: how long any body may take; a second more for every 100 kB that came.
        max_bytes: of all bodies that are on their way or being parsed.
    """

    def __init__(self, grace_s: float, max_bytes: int) -> None:
        self._grace_s = grace_s
        self._max_bytes = max_bytes
        self._held = 0

    @property
    def bytes_held(self) -> int:
        """How much is on its way or being parsed."""
        return self._held

    @asynccontextmanager
    async def body(self, request: Request, limit: int) -> AsyncIterator[bytes]:
        """Read a body, which counts as held until the block ends.

        Raises:
            TooLarge: ``request.too_large``, before the rest of the body is read.
            Overloaded: ``server.busy`` when too much is held.
            TimedOut: ``request.too_slow``.
            ClientDisconnect: when the client hung up.
        """
        declared = request.headers.get("content-length", "")
        size = int(declared[:20]) if declared.isdecimal() else 0  # HTTP's parser allows 20 digits
        if size > limit:
            raise _too_large(limit, f"{size} bytes")
        body = bytearray()
        try:
            async with aclosing(self.chunks(request)) as chunks:
                async for chunk in chunks:
                    if len(body) + len(chunk) > limit:
                        raise _too_large(limit, "more")
                    if self._held + len(chunk) > self._max_bytes:
                        raise refuse(
                            "server.busy", "too many bytes are arriving; try again shortly"
                        )
                    self._held += len(chunk)
                    body += chunk
            yield bytes(body)
        finally:
            self._held -= len(body)

    async def chunks(self, request: Request) -> AsyncGenerator[bytes]:
        """Give the parts of a body as they come, and count none.

        Raises:
            TimedOut: ``request.too_slow``.
            ClientDisconnect: when the client hung up.
        """
        started = asyncio.get_running_loop().time()
        received = 0
        async with aclosing(request.stream()) as stream:
            while True:
                end = started + self._grace_s + received / SLOWEST_BYTES_PER_S
                try:
                    async with asyncio.timeout_at(end):
                        chunk = await anext(stream, None)
                except TimeoutError:
                    raise _too_slow(self._grace_s, f"{received} bytes in that time") from None
                if chunk is None:
                    return
                received += len(chunk)
                yield chunk


def arrivals_of(request: Request) -> Arrivals:
    """Return what ``create_app`` put into the state of the app that serves a request."""
    arrivals: Arrivals = request.app.state.arrivals
    return arrivals


class TimelyCalls(grpc.aio.ServerInterceptor):  # type: ignore[type-arg]
    """Ends calls over gRPC whose messages do not come, or are no messages.

    Args:
        envelope: answers calls that end so before they have begun.
        connections: are told which of them have calls.
        grace_s: longest silence within a stream.
        max_message_bytes: of one message. How much of it is there cannot be seen, so that each
            has the time of the largest: ``grace_s``, and a second for every 100 kB.
    """

    def __init__(
        self,
        envelope: Envelope,
        connections: GrpcConnections,
        grace_s: float,
        max_message_bytes: int,
    ) -> None:
        self._envelope = envelope
        self._connections = connections
        self._patience_s = grace_s + max_message_bytes / SLOWEST_BYTES_PER_S
        self._silence_s = grace_s

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable[Handler]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> Handler:
        """Watch over one call."""
        handler: Handler | None = await continuation(handler_call_details)
        if handler is None:
            return handler  # type: ignore[return-value]  # gRPC says that there is none
        behaviour = behaviour_of(handler)
        name = handler_call_details.method.rpartition("/")[2]
        patience_s = self._patience_s if name in _LARGE_MESSAGES else self._silence_s

        async def serve(messages: AsyncIterator[Any], context: Context) -> Any:
            with self._connections.in_use(context.peer()):
                try:
                    return await behaviour(_timely(messages, patience_s), context)
                except (TimedOut, InvalidInput) as error:  # before the method's own envelope
                    await self._envelope.refuse(name, error, context)

        return handler_like(handler, serve, _readable_or_not(handler.request_deserializer))


class _Unreadable(NamedTuple):
    """Stands for a message that could not be parsed; gRPC would end the call as its own error."""

    reason: str


def _readable_or_not(parse: Callable[[bytes], Any] | None) -> Callable[[bytes], Any]:
    def parsed(message: bytes) -> Any:
        try:
            return message if parse is None else parse(message)
        except DecodeError as error:
            return _Unreadable(str(error))

    return parsed


async def _timely(messages: AsyncIterator[Any], patience_s: float) -> AsyncGenerator[Any]:
    while True:
        try:
            async with asyncio.timeout(patience_s):
                message = await anext(messages, None)
        except TimeoutError:
            raise _too_slow(patience_s, "no message in that time") from None
        if message is None:
            return
        if isinstance(message, _Unreadable):
            raise refuse(
                "request.malformed",
                "the message does not fit the method",
                expected="a protobuf message as in localization.proto",
                got=message.reason,
            )
        yield message


def _too_large(limit: int, got: str) -> VislocError:
    return refuse("request.too_large", expected=f"at most {limit} bytes", got=got)


def _too_slow(seconds: float, got: str) -> VislocError:
    return refuse(
        "request.too_slow",
        expected=f"all within {seconds:g} s, and a second more for every 100 kB",
        got=got,
    )
