"""HTTP connections: how many are open at once, and which is closed to let a new one in."""

from __future__ import annotations

import asyncio
import errno
import logging
import math
import socket
import ssl
from abc import ABC, abstractmethod
from collections.abc import Callable
from time import monotonic
from typing import Any

logger = logging.getLogger(__name__)

# accept() fails so when the system has nothing left for any connection. Its other errors are those
# of one connection that waited.
_SHORTAGES = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)
# Accepted in one turn of the event loop, so that requests have their turn in a flood.
_BATCH = 64
# A new connection is not closed for the next before it had this long to send a request; a flood
# waits in the backlog instead, in which nobody is passed over.
_LEAST_IDLE_S = 0.1
# Pause before accepting again when the system has nothing left for a connection.
_RETRY_S = 0.1
# How long nothing of that kind may happen until the episode counts as over.
_EPISODE_S = 10.0


class Connection(asyncio.Protocol, ABC):
    """What must be known of a connection.

    Attributes:
        opening: makes the connection; waits for the handshake of TLS.
    """

    opening: asyncio.Task[None] | None = None

    @property
    @abstractmethod
    def is_sending(self) -> bool:
        """Whether a part of the last answer has not left yet."""

    @abstractmethod
    def abandon(self) -> None:
        """Close at once, even within the handshake of TLS."""


class OpenConnections:
    """The open connections of a port: at most ``limit``, and the longest idle goes first.

    Attributes:
        limit: of connections.

    A connection is in use from the end of a request's head to the end of its answer. Before and
    after, it is idle, and is closed when a new one needs its place.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self._reserve = min(max(1, limit // 10), limit - 1)
        self._open: set[Connection] = set()
        self._idle: dict[Connection, float] = {}  # since when, the longest idle first

    def __len__(self) -> int:
        return len(self._open)

    @property
    def is_busy(self) -> bool:
        """Whether all are in use but the last tenth, or one, which is for health and metrics."""
        return len(self._open) - len(self._idle) > self.limit - self._reserve

    def add(self, connection: Connection) -> None:
        """Count a new connection."""
        self._open.add(connection)
        self._idle[connection] = monotonic()

    def remove(self, connection: Connection) -> None:
        """Forget a connection that is closed."""
        self._open.discard(connection)
        self._idle.pop(connection, None)

    def note(self, connection: Connection, *, in_use: bool) -> None:
        """Say whether a connection is in use. One that stays idle keeps its place in the order."""
        if in_use:
            self._idle.pop(connection, None)
        elif connection in self._open:
            self._idle.setdefault(connection, monotonic())

    def make_room(self) -> float:
        """Close the longest idle connection at the limit.

        Returns:
            Seconds until there is room: 0 when there is room now, infinity when all are in use.
        """
        if len(self._open) < self.limit:
            return 0.0
        idlest = self._idlest()
        if idlest is None:
            return math.inf
        wait_s = self._idle[idlest] + _LEAST_IDLE_S - monotonic()
        if wait_s > 0:
            return wait_s
        self._close(idlest)
        return 0.0

    def close_idle(self, most: int) -> None:
        """Close the connections that are idle longest."""
        for _ in range(most):
            idlest = self._idlest()
            if idlest is None:
                return
            self._close(idlest)

    def close_unopened(self) -> None:
        """Close the connections whose handshake of TLS has not ended."""
        for each in list(self._open):
            if each.opening is not None and not each.opening.done():
                self._close(each)

    def _idlest(self) -> Connection | None:
        return next((each for each in self._idle if not each.is_sending), None)

    def _close(self, connection: Connection) -> None:
        self.remove(connection)
        connection.abandon()


class Acceptor:
    """Accepts the connections of a port, from when it is made until ``close``.

    ``asyncio``'s own server accepts without a bound. When descriptors run out it writes thousands
    of log lines per second and leaves no time for requests.

    Args:
        listener: the listening socket.
        connections: those of this port.
        make: makes the protocol of a new connection.
        context: of TLS; None for none.
        handshake_s: longest handshake of TLS.
    """

    def __init__(
        self,
        listener: socket.socket,
        connections: OpenConnections,
        make: Callable[[], Connection],
        context: ssl.SSLContext | None,
        handshake_s: float,
    ) -> None:
        self._listener = listener
        self._connections = connections
        self._make = make
        self._tls: dict[str, Any] = {}
        if context is not None:
            self._tls = {"ssl": context, "ssl_handshake_timeout": handshake_s}
        self._loop = asyncio.get_running_loop()
        self._accepted: socket.socket | None = None  # waits for room
        self._pausing: asyncio.TimerHandle | None = None
        self._episode: asyncio.TimerHandle | None = None
        listener.setblocking(False)
        self._resume()

    def close(self) -> None:
        """Take in who has connected already, and nobody else."""
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
        pause_s = self._take(_BATCH)
        if pause_s > 0:
            self._loop.remove_reader(self._listener)
            self._pausing = self._loop.call_later(pause_s, self._resume)

    def _take(self, most: int) -> float:
        """Accept so many that have connected, or fewer.

        Returns:
            After how many seconds to try again: 0 for when somebody connects.
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
        try:
            await self._loop.connect_accepted_socket(lambda: connection, accepted, **self._tls)
        except OSError:  # TLS did not come about: the client's affair
            self._connections.remove(connection)

    def _note_shortage(self, error: OSError) -> None:
        """Log the beginning of an episode of this error, and its end later."""
        if self._episode is None:
            logger.error("no connection can be accepted, idle ones are closed: %s", error)
        else:
            self._episode.cancel()
        self._episode = self._loop.call_later(_EPISODE_S, self._end_episode)

    def _end_episode(self) -> None:
        self._episode = None
        logger.warning("connections have been accepted for %g s again", _EPISODE_S)
