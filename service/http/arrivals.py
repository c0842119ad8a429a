"""Reads the bodies of HTTP requests within limits of time and memory."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import aclosing, asynccontextmanager

from starlette.requests import Request

from service.errors import too_slow
from service.settings import SLOWEST_BYTES_PER_S
from visloc.errors import VislocError, refuse


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
        """Read a body. Its bytes count as held until the block ends."""
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
        """Yield the chunks of a body as they arrive. They do not count as held."""
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
