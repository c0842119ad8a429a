"""TLS handshakes that many clients begin at once, without a service."""

from __future__ import annotations

import asyncio
import socket
import ssl
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path

import pytest

from service.http.acceptor import Acceptor, OpenConnections
from tests.service.http.test_acceptor import Talk
from tests.service.security.test_tls import make_certificate

COUNT = 30


def hello() -> bytes:
    """What a client says first."""
    out = ssl.MemoryBIO()
    client = ssl.create_default_context().wrap_bio(ssl.MemoryBIO(), out, server_hostname="x")
    with pytest.raises(ssl.SSLWantReadError):
        client.do_handshake()
    return out.read()


def context_of(tmp_path: Path) -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(*make_certificate(tmp_path))
    return context


def test_each_handshake_has_a_turn_of_the_event_loop(tmp_path: Path) -> None:
    context, begun = context_of(tmp_path), list[int]()

    async def run() -> None:
        turns, done = 0, asyncio.Event()

        async def count() -> None:
            nonlocal turns
            while not done.is_set():
                turns += 1
                await asyncio.sleep(0)

        def begin() -> ssl.SSLContext:
            begun.append(turns)
            if len(begun) == COUNT:
                done.set()
            return context

        with socket.create_server(("127.0.0.1", 0), backlog=256) as listener, ExitStack() as stack:
            connections = OpenConnections(2 * COUNT)
            acceptor = Acceptor(listener, connections, Talk, begin, 30.0)
            address = listener.getsockname()
            clients = [stack.enter_context(socket.create_connection(address)) for _ in range(COUNT)]
            while len(connections) < COUNT:  # all are accepted, and silent
                await asyncio.sleep(0.01)
            assert not begun
            for each in clients:
                each.sendall(hello())
            await asyncio.wait_for(count(), 30)
            acceptor.close()
            connections.close_unopened()
            await asyncio.sleep(0)

    asyncio.run(run())
    assert all(before < after for before, after in pairwise(begun))


def test_none_is_accepted_while_a_handshake_waits_for_its_turn(tmp_path: Path) -> None:
    context, open_then = context_of(tmp_path), list[int]()

    async def run() -> None:
        connections, done = OpenConnections(10 * COUNT), asyncio.Event()

        def begin() -> ssl.SSLContext:
            open_then.append(len(connections))
            if len(open_then) == COUNT:
                done.set()
            return context

        with socket.create_server(("127.0.0.1", 0), backlog=256) as listener, ExitStack() as stack:
            acceptor = Acceptor(listener, connections, Talk, begin, 30.0)
            address = listener.getsockname()
            for _ in range(COUNT):  # the loop is not running: all have come when it looks
                stack.enter_context(socket.create_connection(address)).sendall(hello())
            await asyncio.wait_for(done.wait(), 30)
            acceptor.close()
            connections.close_unopened()
            await asyncio.sleep(0)

    asyncio.run(run())
    waiting = [count - number for number, count in enumerate(open_then)]
    assert max(waiting) <= COUNT // 2


def test_who_says_nothing_is_closed_when_the_time_for_the_handshake_is_over(
    tmp_path: Path,
) -> None:
    context = context_of(tmp_path)

    async def run() -> None:
        connections = OpenConnections(10)
        with socket.create_server(("127.0.0.1", 0)) as listener:
            acceptor = Acceptor(listener, connections, Talk, lambda: context, 0.1)
            reader, writer = await asyncio.open_connection(*listener.getsockname())
            assert await asyncio.wait_for(reader.read(), 30) == b""
            assert len(connections) == 0
            acceptor.close()
            writer.close()

    asyncio.run(run())
