"""Clients that hold, fill or flood connections: kinds of attacks, over HTTP and gRPC.

HTTP/2 is written by hand, because no library sends what is sent here (RFC 9113; header fields as
literals without an index, RFC 7541 section 6.2.2).
"""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import socket
import struct
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from time import process_time

Play = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]

# Before a connection that was closed is opened again.
PAUSE_S = 10.0
# Attackers give way to the honest client, which shares its core with them and not with the service.
_NICE = 19
# A flood sends so many bytes, twenty times a second, on each of its connections.
_FLOOD_BYTES, _FLOOD_PAUSE_S = 4096, 0.05
_PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
_DATA, _HEADERS, _RESET, _SETTINGS, _PING, _CONTINUATION = 0, 1, 3, 4, 6, 9
_END_STREAM, _END_HEADERS = 1, 4
_INITIAL_WINDOW_SIZE = 4
_POST = b"POST /localize HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"


@dataclass(frozen=True)
class Attack:
    """One kind of attack.

    Attributes:
        name: what its connections do.
        api: ``HTTP`` or ``gRPC``, to which they go.
        play: one connection, until it has had enough or is closed.
        is_flood: whether few connections send much, rather than many next to nothing.
        one_in: where each connection costs a request, there are so many times fewer of them.
    """

    name: str
    api: str
    play: Play
    is_flood: bool = False
    one_in: int = 1


@dataclass(frozen=True)
class Assault:
    """An attack on a port of this machine.

    Attributes:
        name: of one of ``ATTACKS``.
        port: that is attacked.
        connections: at once.
        pause_s: before a connection that was closed is opened again.
        source: the address from which the connections come.
    """

    name: str
    port: int
    connections: int
    pause_s: float = PAUSE_S
    source: str = "127.0.0.1"

    @property
    def attack(self) -> Attack:
        """The attack of this name."""
        return next(each for each in ATTACKS if each.name == self.name)


@asynccontextmanager
async def attacked(assaults: Sequence[Assault]) -> AsyncIterator[Counter[str]]:
    """Attack while the block runs, from a process of its own, which slows no honest client down.

    Yields:
        How many connections were opened and ended, and the attackers' processor time; filled when
        the block has ended.
    """
    seen: Counter[str] = Counter()
    spawning = multiprocessing.get_context("spawn")
    ours, theirs = spawning.Pipe()
    process = spawning.Process(
        target=_attack_until_told, args=(tuple(assaults), theirs), daemon=True
    )
    process.start()
    theirs.close()
    try:
        await asyncio.to_thread(ours.recv)  # it has begun
        yield seen
    finally:
        ours.send(None)
        seen.update(await asyncio.to_thread(ours.recv))
        await asyncio.to_thread(process.join)


def _attack_until_told(assaults: Sequence[Assault], pipe: Connection) -> None:
    os.nice(_NICE)
    asyncio.run(_attack(assaults, pipe))


async def _attack(assaults: Sequence[Assault], pipe: Connection) -> None:
    seen: Counter[str] = Counter()
    running = [
        asyncio.create_task(_attacker(assault, seen))
        for assault in assaults
        for _ in range(assault.connections)
    ]
    pipe.send(None)
    await asyncio.to_thread(pipe.recv)
    for task in running:
        task.cancel()
    await asyncio.gather(*running, return_exceptions=True)
    seen["ms of the attackers' processor"] = round(1000 * process_time())
    pipe.send(seen)


async def _attacker(assault: Assault, seen: Counter[str]) -> None:
    while True:
        with suppress(OSError, asyncio.IncompleteReadError):
            reader, writer = await _connected(assault)
            seen["opened"] += 1
            try:
                await assault.attack.play(reader, writer)
            finally:
                seen["ended"] += 1
                writer.transport.abort()
        await asyncio.sleep(assault.pause_s)


async def _connected(assault: Assault) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    connection = socket.socket()
    connection.setblocking(False)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)  # for those that do not read
    try:
        connection.bind((assault.source, 0))
        await asyncio.get_running_loop().sock_connect(connection, ("127.0.0.1", assault.port))
        return await asyncio.open_connection(sock=connection, limit=1024)
    except BaseException:
        connection.close()
        raise


async def _idle(reader: asyncio.StreamReader, _: asyncio.StreamWriter) -> None:
    await _until_closed(reader)


def _slowly(at_once: bytes, slowly: bytes) -> Play:
    """Send the first bytes, one of the others every second, and then nothing."""

    async def play(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(at_once)
        closed = asyncio.create_task(_until_closed(reader))
        try:
            for byte in slowly:
                writer.write(bytes([byte]))
                await writer.drain()
                await asyncio.wait({closed}, timeout=1)
                if closed.done():
                    return
            await closed
        finally:
            closed.cancel()

    return play


def _flood(at_once: bytes, next_bytes: Callable[[int], bytes]) -> Play:
    """Send the first bytes, and then what is made of the numbers 0, 1, 2, ..., as is taken."""

    async def play(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(at_once)
        closed, number = asyncio.create_task(_until_closed(reader)), 0
        try:
            while not closed.done():
                sent = bytearray()
                while len(sent) < _FLOOD_BYTES:
                    sent += next_bytes(number)
                    number += 1
                writer.write(sent)
                await writer.drain()
                await asyncio.sleep(_FLOOD_PAUSE_S)
        finally:
            closed.cancel()

    return play


def _unread(request: bytes) -> Play:
    """Ask for much, and take nothing of it."""

    async def play(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(request)
        await asyncio.sleep(60)  # without reading, nobody notices that it is closed

    return play


async def _half_closed(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    writer.write(_POST)
    writer.write_eof()
    await _until_closed(reader)


async def _no_http(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    writer.write(b"this is no HTTP\r\n\r\n")
    await _until_closed(reader)


async def _until_closed(reader: asyncio.StreamReader) -> None:
    with suppress(OSError):
        while await reader.read(65536):
            pass


def _frame(kind: int, flags: int, stream: int, payload: bytes = b"") -> bytes:
    return struct.pack(">I", len(payload))[1:] + struct.pack(">BBI", kind, flags, stream) + payload


def _call(method: str) -> bytes:
    fields = {
        ":method": "POST",
        ":scheme": "http",
        ":path": method,
        ":authority": "localhost",
        "te": "trailers",
        "content-type": "application/grpc",
    }
    return b"".join(
        b"\0" + b"".join(bytes([len(text)]) + text.encode() for text in field)
        for field in fields.items()
    )


_HELLO = _PREFACE + _frame(_SETTINGS, 0, 0)
_LIST_MAPS, _LOCALIZE = (
    _call(f"/visloc.v1.{name}") for name in ("Maps/ListMaps", "Localization/Localize")
)
_EMPTY_MESSAGE = bytes(5)


def _reset(number: int) -> bytes:
    stream = 2 * number + 1
    called = _frame(_HEADERS, _END_HEADERS, stream, _LIST_MAPS)
    return called + _frame(_RESET, 0, stream, struct.pack(">I", 8))


def _unread_call() -> bytes:
    no_window = _frame(_SETTINGS, 0, 0, struct.pack(">HI", _INITIAL_WINDOW_SIZE, 0))
    calls = b"".join(
        _frame(_HEADERS, _END_HEADERS, stream, _LIST_MAPS)
        + _frame(_DATA, _END_STREAM, stream, _EMPTY_MESSAGE)
        for stream in range(1, 20, 2)
    )
    return _PREFACE + no_window + calls


ATTACKS = (
    Attack("say nothing", "HTTP", _idle),
    Attack("send a head, a byte a second", "HTTP", _slowly(_POST, b"X-Slow: " + b"a" * 10_000)),
    Attack(
        "send a body, a byte a second",
        "HTTP",
        _slowly(_POST + b"Content-Length: 100000\r\n\r\n", b" " * 100_000),
    ),
    Attack(
        "do not read large answers",
        "HTTP",
        _unread(b"GET /openapi.json HTTP/1.1\r\nHost: localhost\r\n\r\n" * 4),
        one_in=5,
    ),
    Attack("end their half within a head", "HTTP", _half_closed),
    Attack("send no HTTP", "HTTP", _no_http),
    Attack(
        "flood with chunks of a byte",
        "HTTP",
        _flood(_POST + b"Transfer-Encoding: chunked\r\n\r\n", lambda _: b"1\r\n \r\n"),
        is_flood=True,
    ),
    Attack("say hello and nothing else", "gRPC", _slowly(_HELLO, b"")),
    Attack("send HTTP/2's preface, a byte a second", "gRPC", _slowly(b"", _PREFACE)),
    Attack(
        "send a message, a byte a second",
        "gRPC",
        _slowly(
            _HELLO
            + _frame(_HEADERS, _END_HEADERS, 1, _LOCALIZE)
            + _frame(_DATA, 0, 1, b"\0\0\1\0\0"),
            _frame(_DATA, 0, 1, b"\n") * 100,
        ),
    ),
    Attack("do not read answers", "gRPC", _unread(_unread_call()), one_in=5),
    Attack("flood with calls that they reset", "gRPC", _flood(_HELLO, _reset), is_flood=True),
    Attack(
        "flood with settings",
        "gRPC",
        _flood(_HELLO, lambda number: _frame(_SETTINGS, 0, 0, struct.pack(">HI", 1, number))),
        is_flood=True,
    ),
    Attack(
        "flood with pings", "gRPC", _flood(_HELLO, lambda _: _frame(_PING, 0, 0, bytes(8))), True
    ),
    Attack(
        "flood with a head that does not end",
        "gRPC",
        _flood(
            _HELLO + _frame(_HEADERS, 0, 1, _LIST_MAPS),
            lambda number: _frame(_CONTINUATION, 0, 1, b"\0\5x%04d\1a" % (number % 10_000)),
        ),
        is_flood=True,
    ),
)
