"""What requests without a key write into the log, however they are framed."""

from __future__ import annotations

import logging
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, suppress
from io import StringIO
from typing import Any

import pytest

from service.security.key_file import Scope, edited_keys, new_key
from service.telemetry.logs import TextFormatter

HOST = b"Host: localhost\r\n"
GET = b"GET /healthz HTTP/1.1\r\n" + HOST + b"\r\n"


def chunked(body: bytes, start: bytes = b"POST /localize", more: bytes = b"") -> tuple[bytes, ...]:
    """A head, and a body that may be no chunks."""
    head = start + b" HTTP/1.1\r\n" + HOST + more + b"Transfer-Encoding: chunked\r\n\r\n"
    return head, body


def sized(length: bytes, body: bytes, more: bytes = b"") -> tuple[bytes, ...]:
    return (
        b"POST /localize HTTP/1.1\r\n" + HOST + more + b"Content-Length: " + length + b"\r\n\r\n",
        body,
    )


def head(line: bytes, *fields: bytes) -> tuple[bytes, ...]:
    return line + b"\r\n" + HOST + b"".join(field + b"\r\n" for field in fields) + b"\r\n", b""


JSON = b"Content-Type: application/json\r\n"
EXPECT = b"Expect: 100-continue\r\n"
NO_KEY = b"X-API-Key: visloc_000000000000_" + b"a" * 43 + b"\r\n"
ZIP = b"Content-Type: application/zip\r\n"
VERSION = b"PUT /maps/a/versions/20261128T000000Z"
FORM = b"Content-Type: multipart/form-data; boundary=b\r\n"

# Name, then what is sent first and what follows: at once, or in a packet of its own.
FRAMINGS: dict[str, tuple[bytes, ...]] = {
    # Chunks that are none.
    "chunk of no hex": chunked(b"zz\r\n"),
    "chunk of no hex, unread": chunked(b"zz\r\n", b"GET /healthz"),
    "chunk of no hex, no route": chunked(b"zz\r\n", b"GET /nothing"),
    "chunk of no hex, page": chunked(b"zz\r\n", b"GET /"),
    "chunk of no hex, HEAD": chunked(b"zz\r\n", b"HEAD /healthz"),
    "chunk of no hex, OPTIONS": chunked(b"zz\r\n", b"OPTIONS /localize"),
    "chunk of no hex, upload": chunked(b"zz\r\n", VERSION, ZIP),
    "chunk of no hex, JSON": chunked(b"zz\r\n", more=JSON),
    "chunk of no hex, form": chunked(b"zz\r\n", more=FORM),
    "chunk of no hex, wrong key": chunked(b"zz\r\n", more=NO_KEY),
    "chunk of no hex, expected": chunked(b"zz\r\n", more=EXPECT),
    "chunk of no hex, rig": chunked(b"zz\r\n", b"POST /localize/rig", JSON),
    "chunk of no hex, sequence": chunked(b"zz\r\n", b"POST /localize/sequence", JSON),
    "chunk of no hex after a good one": chunked(b"2\r\n{}\r\nzz\r\n"),
    "chunk with prefix 0x": chunked(b"0x5\r\nabcde\r\n0\r\n\r\n"),
    "chunk with plus": chunked(b"+5\r\nabcde\r\n0\r\n\r\n"),
    "chunk of a negative size": chunked(b"-5\r\nabcde\r\n0\r\n\r\n"),
    "chunk with underscore": chunked(b"1_0\r\nabcde\r\n0\r\n\r\n"),
    "chunk without size": chunked(b"\r\nabcde\r\n"),
    "chunk of a huge size": chunked(b"fffffffffffffffff1\r\nabcde\r\n0\r\n\r\n"),
    "chunk of 2^80 bytes": chunked(b"f" * 20 + b"\r\nabcde\r\n0\r\n\r\n"),
    "chunk size that does not end": chunked(b"0" * 70_000),
    "chunk size after a blank": chunked(b" 5\r\nabcde\r\n0\r\n\r\n"),
    "chunk longer than its size": chunked(b"2\r\n{}XX\r\n0\r\n\r\n"),
    "chunk shorter than its size": chunked(b"9\r\n{}\r\n0\r\n\r\n"),
    "chunk with an extension": chunked(b"2;a=b\r\n{}\r\n0\r\n\r\n"),
    "chunk with a long extension": chunked(b"2;" + b"a" * 100_000 + b"\r\n{}\r\n0\r\n\r\n"),
    "chunk with NUL": chunked(b"2\0\r\n{}\r\n0\r\n\r\n"),
    "chunks that end with LF": chunked(b"2\n{}\n0\n\n"),
    "chunks that end with CR": chunked(b"2\r{}\r0\r\r"),
    "chunks that are many and small": chunked(b"1\r\nx\r\n" * 5000),
    "chunks, and more after them": chunked(b"0\r\n\r\nGARBAGE\r\n\r\n"),
    "a request in place of a chunk": chunked(GET),
    "binary in place of a chunk": chunked(bytes(range(256))),
    "trailers": chunked(b"0\r\nX-API-Key: a\r\n\r\n"),
    "a trailer that is none": chunked(b"0\r\nthis is no field\r\n\r\n"),
    "a trailer with NUL": chunked(b"0\r\nX: \0\r\n\r\n"),
    "a long trailer": chunked(b"0\r\nX: " + b"a" * 100_000 + b"\r\n\r\n"),
    # Lengths and codings.
    "length and chunked": chunked(b"zz\r\n", more=b"Content-Length: 4\r\n"),
    "length and good chunks": chunked(b"0\r\n\r\n", more=b"Content-Length: 5\r\n"),
    "length that is negative": sized(b"-1", b"abc"),
    "length with plus": sized(b"+3", b"abc"),
    "length of no digits": sized(b"abc", b"abc"),
    "length of 30 digits": sized(b"9" * 30, b"abc"),
    "length of 2^64": sized(b"18446744073709551616", b"abc"),
    "length that is empty": sized(b"", b"abc"),
    "lengths that differ": sized(b"2", b"abc", b"Content-Length: 3\r\n"),
    "length as a list": sized(b"2, 2", b"ab"),
    "length as a list that differs": sized(b"2, 3", b"abc"),
    "body shorter than its length": sized(b"100", b"abc"),
    "body longer than its length": sized(b"3", b"abc" + b"\xff\xfe\0" * 20),
    "body that is expected": sized(b"3", b"abc", EXPECT),
    "an expectation that is unknown": sized(b"3", b"abc", b"Expect: 200-maybe\r\n"),
    "coding that is unknown": head(b"POST /localize HTTP/1.1", b"Transfer-Encoding: gzip, chunked"),
    "coding twice": head(b"POST /localize HTTP/1.1", b"Transfer-Encoding: chunked, chunked"),
    "coding with a vertical tab": head(
        b"POST /localize HTTP/1.1", b"Transfer-Encoding: \x0bchunked"
    ),
    "coding over HTTP/1.0": (
        b"POST /localize HTTP/1.0\r\nTransfer-Encoding: chunked\r\n\r\n",
        b"zz\r\n",
    ),
    # Heads.
    "two hosts": head(b"GET /healthz HTTP/1.1", b"Host: evil"),
    "no host": (b"GET /healthz HTTP/1.1\r\n\r\n", b""),
    "a folded field": head(b"GET /healthz HTTP/1.1", b"X: a\r\n b"),
    "a folded coding": (
        b"POST /localize HTTP/1.1\r\n" + HOST + b"Transfer-Encoding:\r\n chunked\r\n\r\n",
        b"zz\r\n",
    ),
    "a blank before the colon": head(b"GET /healthz HTTP/1.1", b"X : a"),
    "a field without colon": head(b"GET /healthz HTTP/1.1", b"nothing"),
    "a field without name": head(b"GET /healthz HTTP/1.1", b": a"),
    "NUL in a field": head(b"GET /healthz HTTP/1.1", b"X: a\0b"),
    "NUL in the path": head(b"GET /healthz\0 HTTP/1.1"),
    "bare CR in a field": head(b"GET /healthz HTTP/1.1", b"X: a\rGET /x"),
    "bare LF": (b"GET /healthz HTTP/1.1\nHost: localhost\n\n", b""),
    "bytes that are not ASCII in the path": head(b"GET /\xff\xfe HTTP/1.1"),
    "a path of escapes that are not UTF-8": head(b"GET /maps/%ff%fe%00 HTTP/1.1"),
    "a path of escapes of line ends": head(b"GET /maps/%0d%0aforged%20line HTTP/1.1"),
    "a path with a bad escape": head(b"GET /%zz%u0041 HTTP/1.1"),
    "an id with quotes": head(b"GET /maps HTTP/1.1", b'X-Request-Id: a"b}{"level":"error"'),
    "a long id": head(b"GET /maps HTTP/1.1", b"X-Request-Id: " + b"a" * 5000),
    "a long field": head(b"GET /healthz HTTP/1.1", b"X: " + b"a" * 100_000),
    "many fields": head(b"GET /healthz HTTP/1.1", *(b"X%d: a" % i for i in range(5000))),
    "a long path": head(b"GET /" + b"a" * 100_000 + b" HTTP/1.1"),
    "a long query": head(b"POST /localize?" + b"a=b&" * 3000 + b" HTTP/1.1"),
    "no path": head(b"GET HTTP/1.1"),
    "a method that is none": head(b"G(T /healthz HTTP/1.1"),
    "a method that is unknown": head(b"BREW /healthz HTTP/1.1"),
    "CONNECT": head(b"CONNECT 127.0.0.1:22 HTTP/1.1"),
    "TRACE": head(b"TRACE /healthz HTTP/1.1"),
    "an absolute path": head(b"GET http://evil.example/healthz HTTP/1.1"),
    "a star": head(b"OPTIONS * HTTP/1.1"),
    "HTTP/0.9": (b"GET /healthz\r\n", b""),
    "HTTP/1.0": (b"GET /healthz HTTP/1.0\r\n\r\n", b""),
    "HTTP/9.9": head(b"GET /healthz HTTP/9.9"),
    "HTTP/11": head(b"GET /healthz HTTP/11"),
    "a preface of HTTP/2": (b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", b"\0\0\0\4\0\0\0\0\0"),
    "an upgrade to HTTP/2": head(
        b"GET /healthz HTTP/1.1",
        b"Connection: Upgrade, HTTP2-Settings",
        b"Upgrade: h2c",
        b"HTTP2-Settings: AAMAAABkAARAAAAAAAIAAAAA",
    ),
    "an upgrade to WebSocket": head(
        b"GET /healthz HTTP/1.1",
        b"Connection: Upgrade",
        b"Upgrade: websocket",
        b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
        b"Sec-WebSocket-Version: 13",
    ),
    "a TLS hello": (bytes.fromhex("16030100c8010000c40303"), bytes(range(200))),
    "nothing but line ends": (b"\r\n" * 100, b"\n" * 100),
    "a NUL": (b"\0", b""),
    "noise": (bytes(range(256)), bytes(range(255, -1, -1))),
    "SSH": (b"SSH-2.0-OpenSSH_9.2\r\n", b""),
    # One after the other.
    "three in a row": (GET, GET * 2),
    "a good one, then noise": (GET, b"\xff\0\xff" * 20 + b"\r\n\r\n"),
    "a good one, then a bad chunk": (GET, b"".join(chunked(b"zz\r\n", b"GET /healthz"))),
    "a bad chunk, then a good one": (b"".join(chunked(b"zz\r\n", b"GET /healthz")), GET),
    "two bad chunks": tuple(b"".join(chunked(b"zz\r\n", b"GET /healthz")) for _ in range(2)),
    "one that closes, then another": (
        b"GET /healthz HTTP/1.1\r\n" + HOST + b"Connection: close\r\n\r\n",
        GET,
    ),
    "an unread body, then noise": (b"".join(chunked(b"0\r\n\r\n")), b"\0\1\2\r\n\r\n"),
}


@pytest.fixture(scope="module")
def server(
    serve: Callable[..., AbstractContextManager[Any]], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Any]:
    """A service that asks for keys, and has no map."""
    folder = tmp_path_factory.mktemp("framings")
    (folder / "maps").mkdir()
    key, _ = new_key("one", frozenset(Scope))
    with edited_keys(folder / "keys.json") as keys:
        keys.append(key)
    with serve(folder / "maps", load=False, keys_file=folder / "keys.json") as doors:
        yield doors.server


@pytest.fixture
def log() -> Iterator[StringIO]:
    """What ``configure_logging`` makes the service log, except the lines of requests."""
    written = StringIO()
    handler = logging.StreamHandler(written)
    handler.setFormatter(TextFormatter())
    handler.addFilter(lambda record: record.name != "service.access")
    root, ours = logging.getLogger(), logging.getLogger("service")
    before = ours.level
    root.addHandler(handler)
    ours.setLevel(logging.INFO)
    yield written
    ours.setLevel(before)
    root.removeHandler(handler)


@pytest.mark.parametrize("split", [False, True], ids=["at once", "split"])
@pytest.mark.parametrize("name", FRAMINGS)
def test_a_framing_without_a_key_writes_nothing_but_the_lines_of_requests(
    server: Any, log: StringIO, name: str, split: bool
) -> None:
    first, then = FRAMINGS[name]
    closed = name.startswith("chunk of no hex") and not split
    address, answer = ("127.0.0.1", server.http_port), b""
    with socket.create_connection(address, timeout=10) as connection, suppress(OSError):
        connection.settimeout(10 if closed else 0.05)
        connection.sendall(first if split else first + then)
        if split:
            time.sleep(0.05)
            connection.sendall(then)
        while part := connection.recv(65536):
            answer += part
    deadline = time.monotonic() + 10
    while server.backend.connections or server._http[0].server_state.tasks:
        assert time.monotonic() < deadline
        time.sleep(0.005)
    assert not log.getvalue()
    if closed:  # by HTTP's parser, before the app begins
        assert answer.startswith(b"HTTP/1.1 400 ")
        assert answer.count(b"HTTP/1.1") == 1
