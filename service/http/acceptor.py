"""HTTP connections: their limit, and which one is closed to let a new one in."""

from __future__ import annotations

import asyncio
import errno
import logging
import math
import socket
import ssl
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from time import monotonic
from typing import Any

from starlette.types import ASGIApp, Message, Receive, Scope, Send

logger = logging.getLogger(__name__)

# Errors of accept() that mean that the system has no room for any connection. Its other errors
# concern only the connection that was waiting.
_SHORTAGES = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)
# Connections accepted in one turn of the event loop. An answer takes a dozen turns, so a flood must
# not make them long.
_BATCH = 2
# The time that a new connection has to send a request before it may be closed for the next. A flood
# waits in the backlog, which is served in order.
_LEAST_IDLE_S = 0.1
# The pause before accepting again when the system has no room for a connection.
_RETRY_S = 0.1
# An episode of such errors is over after this time without one.
_EPISODE_S = 10.0


class Connection(asyncio.Protocol, ABC):
    """A connection that ``OpenConnections`` can close.

    Attributes:
        opening: the task that sets the connection up, with its TLS handshake.
    """

    opening: asyncio.Task[None] | None = None

    @property
    @abstractmethod
    def is_sending(self) -> bool:
        """Whether part of an answer is still waiting to be sent."""

    @abstractmethod
    def abandon(self) -> None:
        """Close at once, even during the TLS handshake."""


class OpenConnections:
    """The open connections of a port, at most ``limit``.

    A connection is arriving from the end of a request's head to the end of its body, in use from
    then to the end of its answer, and idle otherwise: new (with or without a TLS handshake), or
    between two requests. At the limit, one connection is closed for each new one:

    - normally the longest idle, of the new ones or of those between two requests, whichever are
      more; if none is idle, the slowest arriving, whose body has made no progress for the longest
      time;
    - the slowest arriving first, if more than half are arriving.

    So a flood closes its own connections: many new ones do not close those of clients that had
    their answers, and many that had answers do not close those that are about to ask.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self._reserve = min(max(1, limit // 10), limit - 1)
        self._open: set[Connection] = set()
        # When each became idle or last made progress, the earliest first.
        self._new: dict[Connection, float] = {}
        self._idle: dict[Connection, float] = {}
        self._arriving: dict[Connection, float] = {}

    def __len__(self) -> int:
        return len(self._open)

    @property
    def is_crowded(self) -> bool:
        """Whether requests that arrive hold most places."""
        return 2 * len(self._arriving) > self.limit

    @property
    def is_busy(self) -> bool:
        """Whether all connections are in use except the tenth reserved for health and metrics."""
        in_use = len(self._open) - len(self._new) - len(self._idle) - len(self._arriving)
        return in_use > self.limit - self._reserve

    def add(self, connection: Connection) -> None:
        """Count a new connection, idle at first."""
        self._open.add(connection)
        self._new[connection] = monotonic()

    def remove(self, connection: Connection) -> None:
        self._open.discard(connection)
        self._new.pop(connection, None)
        self._idle.pop(connection, None)
        self._arriving.pop(connection, None)

    def note(self, connection: Connection, *, in_use: bool, arriving: bool = False) -> None:
        """Record the state of a connection. If the state has not changed, it keeps its rank.

        Args:
            connection: one that may have been removed.
            in_use: whether a request has arrived and has not been answered.
            arriving: whether the body of a request has not arrived completely.
        """
        if in_use or arriving:
            self._new.pop(connection, None)
            self._idle.pop(connection, None)
        if in_use or not arriving:
            self._arriving.pop(connection, None)
        if connection in self._open and connection not in self._new and not in_use:
            (self._arriving if arriving else self._idle).setdefault(connection, monotonic())

    def renew(self, connection: Connection) -> None:
        """Record that the request of a connection has made progress."""
        if self._arriving.pop(connection, None) is not None:
            self._arriving[connection] = monotonic()

    def make_room(self) -> float:
        """At the limit, close a connection for a new one.

        Returns:
            Seconds until a connection can be accepted: 0 if one can be now, infinity if all are
            in use.
        """
        if len(self._open) < self.limit:
            return 0.0
        found = self._next_to_close()
        if found is None:
            return math.inf
        connection, since = found
        # One that has its time yet is waited for: the next best may be that of an honest client.
        wait_s = since + _LEAST_IDLE_S - monotonic()
        if wait_s > 0:
            return wait_s
        self._close(connection)
        return 0.0

    def close_idle(self, most: int) -> None:
        """Close the longest idle connections."""
        for _ in range(most):
            found = self._next_to_close()
            if found is None:
                return
            self._close(found[0])

    def close_unopened(self) -> None:
        """Close the connections that are still in their TLS handshake."""
        for each in list(self._open):
            if each.opening is not None and not each.opening.done():
                self._close(each)

    def _next_to_close(self) -> tuple[Connection, float] | None:
        """Return what gives way to a new connection, and since when it has waited."""
        arriving = _longest(self._arriving)
        if arriving is not None and self.is_crowded:
            return arriving
        kinds = sorted((self._new, self._idle), key=len, reverse=True)
        return _longest(kinds[0]) or _longest(kinds[1]) or arriving

    def _close(self, connection: Connection) -> None:
        self.remove(connection)
        connection.abandon()


def _longest(waiting: Mapping[Connection, float]) -> tuple[Connection, float] | None:
    """Return the first connection with nothing to send, and since when it has waited."""
    return next((each for each in waiting.items() if not each[0].is_sending), None)


class Acceptor:
    """Accepts the connections of a port, from construction until ``close``.

    ``asyncio``'s own server has no limit: when descriptors run out, it writes thousands of log
    lines per second and leaves no time for requests.

    A TLS handshake takes a millisecond of the event loop. It is begun when the client has said
    something, and one at a time has its turn of the loop, in the order in which they came. None is
    accepted while one waits for its turn: the backlog is served in order too.

    Args:
        listener: the listening socket.
        make: makes the protocol of a new connection.
        context: returns the TLS context for a new connection; None for plain HTTP.
        handshake_s: the longest TLS handshake.
    """

    def __init__(
        self,
        listener: socket.socket,
        connections: OpenConnections,
        make: Callable[[], Connection],
        context: Callable[[], ssl.SSLContext] | None,
        handshake_s: float,
    ) -> None:
        self._listener = listener
        self._connections = connections
        self._make = make
        self._context = context
        self._handshake_s = handshake_s
        self._loop = asyncio.get_running_loop()
        self._turn = asyncio.Lock()  # of the event loop, for a handshake
        self._waiting = 0  # handshakes for their turn
        self._accepted: socket.socket | None = None  # waits for room
        self._pausing: asyncio.TimerHandle | None = None
        self._episode: asyncio.TimerHandle | None = None
        listener.setblocking(False)
        self._resume()

    def close(self) -> None:
        """Accept the connections that are already waiting, and stop."""
        self._take(self._connections.limit)
        for timer in (self._pausing, self._episode):
            if timer is not None:
                timer.cancel()
        self._loop.remove_reader(self._listener)
        self._listener.close()
        if self._accepted is not None:
            self._accepted.close()

    def _resume(self) -> None:
        self._loop.add_reader(self._listener, self._accept)
        self._accept()

    def _accept(self) -> None:
        if self._waiting:
            return
        pause_s = self._take(_BATCH)
        if pause_s > 0:
            self._loop.remove_reader(self._listener)
            self._pausing = self._loop.call_later(pause_s, self._resume)

    def _take(self, most: int) -> float:
        """Accept up to ``most`` waiting connections.

        Returns:
            Seconds to wait before the next try; 0 to wait for a connection.
        """
        for _ in range(most):
            try:
                accepted = self._accepted or self._listener.accept()[0]
            except BlockingIOError:
                return 0.0
            except OSError as error:
                if error.errno not in _SHORTAGES:
                    continue
                self._note_shortage(error)
                self._connections.close_idle(_BATCH)
                return _RETRY_S
            wait_s = self._connections.make_room()
            if 0 < wait_s < math.inf:
                self._accepted = accepted
                return wait_s
            self._accepted = None
            if wait_s == 0:
                self._open(accepted)
            else:
                accepted.close()
        return 0.0

    def _open(self, accepted: socket.socket) -> None:
        connection = self._make()
        self._connections.add(connection)
        connection.opening = self._loop.create_task(self._connect(connection, accepted))

    async def _connect(self, connection: Connection, accepted: socket.socket) -> None:
        tls: dict[str, Any] = {}
        try:
            if self._context is not None:
                await self._greeted(accepted)
                tls = {"ssl": self._context(), "ssl_handshake_timeout": self._handshake_s}
            await self._loop.connect_accepted_socket(lambda: connection, accepted, **tls)
        except OSError:  # the client's TLS handshake failed, or it never began
            self._connections.remove(connection)

    async def _greeted(self, accepted: socket.socket) -> None:
        """Wait until a client has said something, and then for a turn of the event loop.

        Raises:
            TimeoutError: when it says nothing. The connection is closed.
        """
        said = asyncio.Event()
        self._loop.add_reader(accepted, said.set)
        try:
            async with asyncio.timeout(self._handshake_s):
                await said.wait()
            self._loop.remove_reader(accepted)
            self._waiting += 1
            try:
                async with self._turn:
                    await asyncio.sleep(0)
            finally:
                self._waiting -= 1
        except BaseException:
            self._loop.remove_reader(accepted)
            accepted.close()
            raise

    def _note_shortage(self, error: OSError) -> None:
        """Log the start of an episode of this error, and later its end."""
        if self._episode is None:
            logger.error("no connection can be accepted; idle ones are closed: %s", error)
        else:
            self._episode.cancel()
        self._episode = self._loop.call_later(_EPISODE_S, self._end_episode)

    def _end_episode(self) -> None:
        self._episode = None
        logger.warning("connections have been accepted for %g s again", _EPISODE_S)


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
