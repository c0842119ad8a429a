"""Requests that do not arrive while others like them hold most connections."""

from __future__ import annotations

import asyncio

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.http.acceptor import OpenConnections

# Of a body that the app waits for no longer: it comes.
_ENOUGH_BYTES, _ENOUGH_S = 64 * 1024, 2.0


class Patient:
    """Lets an app see a request when its body comes, while bodies that do not hold most places.

    Then every new connection closes an older one. A request that the app has begun costs a
    millisecond of the event loop, half a dozen times what its connection costs alone: its route,
    key, log line and metrics, and the end of all that. Requests that nobody means to finish are
    closed before.
    """

    def __init__(self, app: ASGIApp, connections: OpenConnections) -> None:
        self._app = app
        self._connections = connections

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http" and self._connections.is_crowded:
            come = await _beginning(receive)
            if come and come[-1]["type"] == "http.disconnect":
                return
            receive = _repeated(come, receive)
        await self._app(scope, receive, send)


async def _beginning(receive: Receive) -> list[Message]:
    """Return the messages of a request up to its end, or up to a body that comes or is late."""
    come, size = list[Message](), 0
    try:
        async with asyncio.timeout(_ENOUGH_S):
            while size < _ENOUGH_BYTES and (not come or come[-1].get("more_body")):
                come.append(await receive())
                size += len(come[-1].get("body", b""))
    except TimeoutError:
        pass
    return come


def _repeated(come: list[Message], receive: Receive) -> Receive:
    """Give the messages that have come, and then those that come."""

    async def again() -> Message:
        return come.pop(0) if come else await receive()

    return again
