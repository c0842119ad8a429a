"""Idle gRPC connections: the longest idle are closed before there are too many."""

from __future__ import annotations

import asyncio
import os
import socket
import stat
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from ipaddress import IPv6Address, ip_address
from time import monotonic
from urllib.parse import unquote

# A client's address and port, which identify a connection.
Peer = tuple[str, int]

# The pause between two counts of the connections, and its least multiple of the time of a count.
_PERIOD_S = 0.1
_REST = 10
_DESCRIPTORS = "/dev/fd"


class GrpcConnections:
    """Keeps a quarter of the connection slots free by closing the longest idle connections.

    gRPC accepts connections by itself. With ``grpc.max_allowed_incoming_connections`` it refuses
    new ones at the limit, but never closes idle ones, so that silent clients could lock out all
    others. gRPC does not list its connections either. So they are found among the descriptors of
    this process, and shut down like a broken network would. A connection is in use while a call
    runs on it.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._calls = Counter[Peer]()
        self._idle: dict[Peer, None] = {}  # the longest idle first

    @property
    def options(self) -> list[tuple[str, int]]:
        """Options of the gRPC server that set the limit."""
        return [("grpc.max_allowed_incoming_connections", self._limit)]

    @contextmanager
    def in_use(self, peer: str) -> Iterator[None]:
        """Keep a connection open while a call runs on it; ``peer`` is gRPC's ``context.peer()``."""
        caller = _peer_of(peer)
        self._idle.pop(caller, None)
        self._calls[caller] += 1
        try:
            yield
        finally:
            self._calls[caller] -= 1
            if not self._calls[caller]:
                del self._calls[caller]

    async def watch(self, port: int) -> None:
        """Count the connections of a port and close idle ones until cancelled."""
        took_s = 0.0
        while True:
            await asyncio.sleep(max(_PERIOD_S, _REST * took_s))
            started = monotonic()
            with suppress(OSError):  # no descriptor is left to list the descriptors
                self.close_idle(port)
            took_s = monotonic() - started

    def close_idle(self, port: int) -> None:
        """Close the longest idle connections if too few slots are free."""
        free = max(1, self._limit // 4)
        with os.scandir(_DESCRIPTORS) as entries:
            names = [entry.name for entry in entries]
        if len(names) <= self._limit // 2:  # connections are even fewer
            self._idle.clear()
            return
        descriptors = dict(_connections_of(names, port))
        idle = descriptors.keys() - self._calls.keys()
        self._idle = {peer: None for peer in self._idle if peer in idle}
        for peer in descriptors:  # descriptors are roughly ordered by age
            if peer in idle:
                self._idle.setdefault(peer)
        for peer in list(self._idle)[: max(0, len(descriptors) - self._limit + free)]:
            _shut_down(descriptors[peer], peer)


def _connections_of(names: list[str], port: int) -> Iterator[tuple[Peer, int]]:
    """Find the connections of a port among this process's descriptors."""
    for name in names:
        with suppress(OSError):  # not connected, or closed meanwhile
            number = int(name)
            if stat.S_ISSOCK(os.fstat(number).st_mode):
                found = socket.socket(fileno=number)
                try:
                    if found.family in _FAMILIES and found.getsockname()[1] == port:
                        yield _peer(*found.getpeername()[:2]), number
                finally:
                    found.detach()


_FAMILIES = (socket.AF_INET, socket.AF_INET6)


def _shut_down(descriptor: int, peer: Peer) -> None:
    """Shut a connection down, unless its descriptor belongs to another by now."""
    with suppress(OSError), socket.socket(fileno=os.dup(descriptor)) as connection:
        if _peer(*connection.getpeername()[:2]) == peer:
            connection.shutdown(socket.SHUT_RDWR)


def _peer_of(text: str) -> Peer:
    """Read ``ipv4:127.0.0.1:50000`` or ``ipv6:%5B::1%5D:50000``."""
    host, _, port = unquote(text).partition(":")[2].rpartition(":")
    return _peer(host.strip("[]"), int(port))


def _peer(host: str, port: int) -> Peer:
    address = ip_address(host.partition("%")[0])
    mapped = address.ipv4_mapped if isinstance(address, IPv6Address) else None
    return str(mapped or address), port
