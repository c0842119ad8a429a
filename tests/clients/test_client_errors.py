"""Servers that are gone, or are something else."""

from __future__ import annotations

import asyncio
import errno
import json
import socket
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

import pytest

from clients import AsyncClient, Client
from clients.wire.answers import parse_answer, parse_result
from visloc.errors import Conflict, InvalidInput, NotFound, Overloaded, TooLarge, Unavailable

Serve = Callable[..., str]


@pytest.fixture
def closed_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port: int = listener.getsockname()[1]
    return port


@pytest.fixture
def serve() -> Iterator[Serve]:
    """Start an HTTP server that has one answer to everything."""
    servers = []

    def start(status: int, body: bytes, content_type: str = "text/html") -> str:
        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.send_response(status)
                self.send_header("Content-Type", content_type)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *_: Any) -> None:
                pass

        server = HTTPServer(("127.0.0.1", 0), Handler)
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        servers.append((server, thread))
        return f"http://127.0.0.1:{server.server_port}"

    yield start
    for server, thread in servers:
        server.shutdown()
        thread.join()
        server.server_close()


@pytest.mark.parametrize("scheme", ["http", "grpc"])
def test_a_server_that_is_not_there_is_named_with_what_to_check(
    scheme: str, closed_port: int
) -> None:
    url = f"{scheme}://127.0.0.1:{closed_port}"
    with Client(url) as client, pytest.raises(Unavailable) as caught:
        client.maps()
    assert caught.value.code == "server.unreachable"
    assert url in str(caught.value)
    assert "whether it runs" in str(caught.value)


@pytest.mark.parametrize("scheme", ["http", "grpc"])
def test_the_asynchronous_client_says_the_same(scheme: str, closed_port: int) -> None:
    async def ask() -> None:
        async with AsyncClient(f"{scheme}://127.0.0.1:{closed_port}") as client:
            await client.ready()

    with pytest.raises(Unavailable) as caught:
        asyncio.run(ask())
    assert caught.value.code == "server.unreachable"


@pytest.mark.parametrize(
    "address",
    [
        "",
        "localhost:8000",
        "ftp://localhost:80",
        "http://",
        "http://host:port",
        "http://host:0",
        "http://host:65536",
        "http://user:secret@host:80",
        "http://a b:80",
        "http://host:80/?x=1",
        "grpc://host:50051/path",
        "grpc://host:1\n",
        "http://[:]:80",
        "grpc://[:]:80",
        "http://a..b:80",
        "http://.:80",
        f"http://{'a' * 64}:80",
        "http://999.1.1.1:80",
        "http://xn--0.example:80",
        "http://host/\x7f",
        "http://host/\udcff",
    ],
)
def test_an_address_that_cannot_be_used_is_refused_at_once(address: str) -> None:
    for make in (Client, AsyncClient):
        with pytest.raises(InvalidInput) as caught:
            make(address)
        assert caught.value.code == "server.url"


def test_usual_addresses_are_accepted() -> None:
    for address in (
        "http://localhost",
        "https://maps.example.org/visloc/",
        "http://[::1]:8000",
        "grpc://my_service:50051",
        "grpc://10.0.0.1:50051/",
    ):
        Client(address).close()


@pytest.mark.parametrize(
    ("status", "kind", "code"),
    [
        (400, InvalidInput, "request.invalid"),
        (404, NotFound, "request.not_found"),
        (405, InvalidInput, "request.invalid"),
        (409, Conflict, "request.conflict"),
        (413, TooLarge, "request.too_large"),
        (429, Overloaded, "server.overloaded"),
        (500, Unavailable, "server.internal"),
        (502, Unavailable, "server.unavailable"),
        (503, Overloaded, "server.overloaded"),
    ],
)
def test_an_error_without_our_words_goes_by_its_status(
    status: int, kind: type, code: str, serve: Serve
) -> None:
    with Client(serve(status, b"<h1>proxy</h1>")) as client, pytest.raises(kind) as caught:
        client.maps()
    assert type(caught.value) is kind
    assert caught.value.code == code
    assert str(status) in str(caught.value)


def test_an_unknown_kind_of_error_goes_by_its_status_and_keeps_its_words(serve: Serve) -> None:
    problem = {"kind": "Teapot", "code": "tea.short", "detail": "short and stout", "field": "tea"}
    url = serve(409, json.dumps(problem).encode(), "application/problem+json")
    with Client(url) as client, pytest.raises(Conflict) as caught:
        client.maps()
    assert (caught.value.code, str(caught.value)) == ("tea.short", "tea: short and stout")


@pytest.mark.parametrize("body", [b"<html>hello</html>", b"[]", b"{}", b'{"maps": [{}]}', b"\xff"])
def test_another_kind_of_server_is_recognized(body: bytes, serve: Serve) -> None:
    url = serve(200, body)
    with Client(url) as client, pytest.raises(Unavailable) as caught:
        client.maps()
    assert caught.value.code == "server.answer"
    assert caught.value.field == url


def test_a_redirect_is_not_followed(serve: Serve) -> None:
    with Client(serve(302, b"")) as client, pytest.raises(Unavailable, match="302"):
        client.ready()


def test_a_grpc_client_at_an_http_server_is_told(serve: Serve) -> None:
    url = serve(200, b"{}").replace("http:", "grpc:")
    with Client(url, timeout_s=5) as client, pytest.raises(Unavailable) as caught:
        client.maps()
    assert caught.value.code == "server.unreachable"


@pytest.mark.parametrize(
    "change",
    [
        {"status": "perhaps"},
        {"pose": None},
        {"refusal": {"stage": "gate", "reason": "x", "message": "y"}},
        {"inliers": "many"},
        {"camera": {}},
        {"covariance": [1.0] * 35},
        {"rotation_wxyz": [0.0, 0.0, 0.0, 0.0]},
        {"rotation_wxyz": ["NaN", 0.0, 0.0, 1.0]},
        {"rotation_wxyz": [1.0, 0.0, 0.0]},
        {"translation": [0.0, None, 0.0]},
    ],
)
def test_an_answer_that_makes_no_sense_is_the_servers_fault(
    change: dict[str, Any], http_url: str
) -> None:
    with Client(http_url) as client:
        raw = json.loads(json.dumps(client.localize(b"photo", "room").raw))
    for name, value in change.items():
        transform = raw["pose"]["cam_from_world"]
        (transform if name in transform else raw["pose"] if name in raw["pose"] else raw)[name] = (
            value
        )
    with pytest.raises(Unavailable) as caught:
        parse_answer("http://server", parse_result, raw)
    assert caught.value.code == "server.answer"


def test_a_refused_connection_says_so() -> None:
    with Client("http://127.0.0.1:9") as client, pytest.raises(Unavailable) as caught:
        client.ready()
    assert f"Errno {errno.ECONNREFUSED}" in str(caught.value.got)
