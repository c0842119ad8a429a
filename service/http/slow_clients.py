"""Limits how long an HTTP request may take to arrive, and how many bytes may arrive at once."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import aclosing, asynccontextmanager, suppress
from typing import Any

import h11
import uvicorn
from starlette.requests import Request
from uvicorn.protocols.http.h11_impl import H11Protocol

from service.errors import too_slow
from service.http.acceptor import Connection, OpenConnections
from service.settings import SLOWEST_BYTES_PER_S
from visloc.errors import VislocError, refuse

# Largest head of a request: several times what the longest keys and ids need.
_MAX_HEAD_BYTES = 16 * 1024
# Number of chunks that any body may have. Further chunks must have so many bytes each on average,
# because h11 takes five microseconds for a chunk, on the event loop. Small packets need no such
# limit: they cost their sender as much.
_FREE_CHUNKS, _LEAST_CHUNK_BYTES = 2000, 64


class LargeChunks(h11.Connection):
    """HTTP/1.1 of a server that refuses bodies in very many chunks of a few bytes."""

    _chunks = _bytes = 0

    def next_event(self) -> h11.Event | type[h11.NEED_DATA] | type[h11.PAUSED]:
        """Return the next event; too many small chunks are an error of the client like others."""
        event = super().next_event()
        if isinstance(event, h11.Request):
            self._chunks = self._bytes = 0
            # h11 looks at the length of heads only while they are not complete.
            fields = sum(len(name) + len(value) for name, value in event.headers)
            if len(event.target) + fields > _MAX_HEAD_BYTES:
                raise h11.RemoteProtocolError("the head is too large")
        elif isinstance(event, h11.Data):
            self._chunks += event.chunk_start
            self._bytes += len(event.data)
            if self._chunks > _FREE_CHUNKS + self._bytes // _LEAST_CHUNK_BYTES:
                raise h11.RemoteProtocolError("too many small chunks")
        return event


class TimelyProtocol(H11Protocol, Connection):
    """uvicorn's HTTP/1.1, which closes the connections of slow clients.

    A connection is closed in these cases:

    - the head of a request takes longer than ``grace_s`` to arrive;
    - the body of a refused request takes longer than that to end;
    - the client does not take an answer within ``grace_s`` plus a second for every waiting 100 kB;
    - the input is not HTTP. The answer is 400, without a line in the log, which anybody could fill.

    ``Arrivals`` limits the time of bodies that are read, uvicorn that of idle connections.
    """

    grace_s: float
    open_connections: OpenConnections
    _arriving: asyncio.TimerHandle | None = None
    _leaving: asyncio.TimerHandle | None = None
    _received = 0  # bytes since its last recorded progress

    def __init__(self, config: uvicorn.Config, *args: Any, **kwargs: Any) -> None:
        super().__init__(config, *args, **kwargs)
        self.conn = LargeChunks(h11.SERVER, _MAX_HEAD_BYTES)

    def send_400_response(self, msg: str) -> None:
        if self.cycle is not None and not self.cycle.response_complete:
            # The app must not answer too: it has not even begun, where all came in one packet.
            self.cycle.disconnected = True
            self.cycle.message_event.set()
        if self.conn.our_state in (h11.IDLE, h11.SEND_RESPONSE):
            with suppress(h11.LocalProtocolError):  # of HEAD: its answer has no body
                super().send_400_response(msg)
            self.transport.close()
        else:  # the answer had begun before the error
            self.transport.abort()

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        # Pause writing while a single byte waits. TLS pauses at the bound, plain TCP above it.
        transport.set_write_buffer_limits(high=int(self.scheme == "https"), low=0)
        self._watch(first=True)

    def data_received(self, data: bytes) -> None:
        self._received += len(data)
        super().data_received(data)
        self._watch()
        if self._received >= SLOWEST_BYTES_PER_S:
            self._received = 0
            self.open_connections.renew(self)

    def on_response_complete(self) -> None:
        super().on_response_complete()
        self._watch()

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self.open_connections.remove(self)
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
        patience_s = self.grace_s + self.transport.get_write_buffer_size() / SLOWEST_BYTES_PER_S
        # Abort, because close() would wait for the client to take the rest.
        self._leaving = self.loop.call_later(patience_s, self.transport.abort)

    def resume_writing(self) -> None:
        super().resume_writing()
        if self._leaving is not None:
            self._leaving.cancel()

    def _watch(self, *, first: bool = False) -> None:
        """Start the clock when the server waits for the client. More data does not reset it."""
        state = self.conn.their_state
        arriving = state is h11.SEND_BODY and self.conn.our_state is h11.SEND_RESPONSE
        in_use = self.cycle is not None and not self.cycle.response_complete and not arriving
        self.open_connections.note(self, in_use=in_use, arriving=arriving)
        has_part_of_head = state is h11.IDLE and (first or bool(self.conn.trailing_data[0]))
        is_unwanted = state is h11.SEND_BODY and self.conn.our_state is h11.DONE
        if has_part_of_head or is_unwanted:
            self._arriving = self._arriving or self.loop.call_later(
                self.grace_s, self.transport.abort
            )
        elif self._arriving is not None:
            self._arriving.cancel()
            self._arriving = None


def http_protocol(grace_s: float, connections: OpenConnections) -> type[TimelyProtocol]:
    """Return the protocol class of a port; uvicorn makes one instance per connection."""
    bound = {"grace_s": grace_s, "open_connections": connections}
    return type("BoundTimelyProtocol", (TimelyProtocol,), bound)


class Arrivals:
    """Reads the bodies of HTTP requests within limits of time and memory.

    Args:
        grace_s: the longest that any body may take, plus a second for every 100 kB received.
        max_bytes: limit of all bodies together that are arriving or being parsed.
    """

    def __init__(self, grace_s: float, max_bytes: int) -> None:
        self._grace_s = grace_s
        self._max_bytes = max_bytes
        self._held = 0

    @property
    def bytes_held(self) -> int:
        """Bytes of all bodies that are arriving or being parsed."""
        return self._held

    @asynccontextmanager
    async def body(self, request: Request, limit: int) -> AsyncIterator[bytes]:
        """Read a body. Its bytes count as held until the block ends.

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
        """Yield the chunks of a body as they arrive. They do not count as held.

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
                    raise too_slow(self._grace_s, f"{received} bytes in that time") from None
                if chunk is None:
                    return
                received += len(chunk)
                yield chunk


def _too_large(limit: int, got: str) -> VislocError:
    return refuse("request.too_large", expected=f"at most {limit} bytes", got=got)
