from __future__ import annotations

import asyncio
import json
import os
import threading
from collections.abc import Iterator
from concurrent import futures
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import grpc
import pytest

from clients import AsyncClient, Client, Instant, RigImage
from clients.cli.main import main
from clients.cli.options import Connection as Options
from clients.transport.connection import Connection
from visloc.errors import (
    Forbidden,
    InvalidInput,
    TimedOut,
    Unauthenticated,
    Unavailable,
    VislocError,
)
from visloc_api.v1 import localization_pb2 as pb2
from visloc_api.v1 import localization_pb2_grpc as pb2_grpc

KEY = f"visloc_{'0a' * 6}_{'Zz-_' * 10}abc"


@pytest.fixture
def http_door() -> Iterator[tuple[str, list[dict[str, str]]]]:
    """A server that notes the headers it gets, and knows no maps."""
    seen: list[dict[str, str]] = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            seen.append({name.lower(): value for name, value in self.headers.items()})
            self.rfile.read(int(self.headers.get("content-length", 0)))
            body = b'{"maps": []}'
            self.send_response(200)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        do_POST = do_GET  # noqa: N815

        def log_message(self, *_: Any) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}", seen
        server.shutdown()
        thread.join()


class Servicer(pb2_grpc.LocalizationServicer):
    def __init__(self, seen: list[dict[str, str]]) -> None:
        self.seen = seen

    def _note(self, context: Any) -> None:
        self.seen.append(dict(context.invocation_metadata()))

    def ListMaps(self, request: Any, context: Any) -> Any:  # noqa: N802
        del request
        self._note(context)
        return pb2.ListMapsResponse()

    def LocalizeSequence(self, request_iterator: Any, context: Any) -> Any:  # noqa: N802
        self._note(context)
        yield from ()
        list(request_iterator)


@pytest.fixture
def grpc_door() -> Iterator[tuple[str, list[dict[str, str]]]]:
    seen: list[dict[str, str]] = []
    server = grpc.server(futures.ThreadPoolExecutor(2))
    pb2_grpc.add_LocalizationServicer_to_server(
        Servicer(seen),  # type: ignore[abstract]  # what is not called is not there
        server,
    )
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    yield f"grpc://127.0.0.1:{port}", seen
    server.stop(None).wait()


@pytest.fixture(params=["http", "grpc"])
def door(request: pytest.FixtureRequest) -> tuple[str, list[dict[str, str]]]:
    made: tuple[str, list[dict[str, str]]] = request.getfixturevalue(f"{request.param}_door")
    return made


def test_the_key_goes_with_every_request(door: tuple[str, list[dict[str, str]]]) -> None:
    url, seen = door

    async def ask() -> None:
        async with AsyncClient(url, api_key=KEY) as client:
            await client.maps()
            with pytest.raises(Unavailable):
                async for _ in client.localize_sequence(instants(), "room"):
                    pass

    with Client(url, api_key=KEY) as client:
        assert client.maps() == []
        with pytest.raises(Unavailable):  # these servers answer no instant
            list(client.localize_sequence(instants(), "room"))
    asyncio.run(ask())

    assert len(seen) == 4
    assert all(headers["authorization"] == f"Bearer {KEY}" for headers in seen)


def instants() -> list[Instant]:
    return [Instant(1_700_000_000, (RigImage("camera", b"photo"),))]


def test_without_a_key_none_is_sent(door: tuple[str, list[dict[str, str]]]) -> None:
    url, seen = door
    with Client(url) as client:
        client.maps()
    assert "authorization" not in seen[0]


def test_the_server_is_told_how_long_a_photo_may_take(
    http_door: tuple[str, list[dict[str, str]]],
) -> None:
    url, seen = http_door
    with Client(url, timeout_s=2.5) as client:
        client.maps()
        with pytest.raises(Unavailable):
            client.localize(b"photo", "room")
    assert "x-request-timeout" not in seen[0]
    assert seen[1]["x-request-timeout"] == "2.5"


@pytest.mark.parametrize("key", ["", "two words", "line\nbreak", "\u00e4", "k" * 513])
def test_what_cannot_be_sent_as_a_key_is_refused_and_not_shown(key: str) -> None:
    for make in (Client, AsyncClient):
        with pytest.raises(InvalidInput) as caught:
            make("http://localhost", api_key=key)
        assert caught.value.code == "server.api_key"
        assert not key or key not in str(caught.value)


def test_a_key_is_not_shown_with_its_connection() -> None:
    assert KEY not in repr(Connection("http://localhost", 1.0, KEY))


@pytest.mark.parametrize("scheme", ["https", "grpcs"])
def test_certificates_that_cannot_be_read_are_refused(scheme: str, tmp_path: Path) -> None:
    garbage = tmp_path / "ca.pem"
    garbage.write_text("garbage")
    for path in (garbage, tmp_path / "none.pem"):
        with pytest.raises(InvalidInput) as caught:
            Client(f"{scheme}://localhost", ca=path)
        assert (caught.value.code, caught.value.field) == ("server.ca", str(path))


def test_the_arguments_of_the_command_name_a_file_and_the_environment_has_the_key(
    http_door: tuple[str, list[dict[str, str]]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    url, seen = http_door
    file = tmp_path / "key"
    file.write_text(f"{KEY}\n")

    def run(*arguments: str) -> None:
        with pytest.raises(SystemExit) as caught:
            main(["maps", "list", "--server", url, *arguments])
        assert caught.value.code == 0

    monkeypatch.delenv("VISLOC_API_KEY", raising=False)
    run()
    run("--api-key-file", str(file))
    monkeypatch.setenv("VISLOC_API_KEY", "from-environment")
    run()
    run("--api-key-file", str(file))
    sent = [headers.get("authorization") for headers in seen]
    assert sent == [None, f"Bearer {KEY}", "Bearer from-environment", f"Bearer {KEY}"]


def test_the_file_with_the_key_is_read_once() -> None:
    reading, writing = os.pipe()  # as from <(a command) in a shell
    os.write(writing, KEY.encode())
    os.close(writing)
    connection = Options(api_key_file=Path(f"/dev/fd/{reading}"))
    with connection.client():
        asyncio.run(connection.async_client().close())
    os.close(reading)


def test_a_file_without_a_key_is_an_error_of_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    empty = tmp_path / "empty"
    empty.write_text("\n")
    for path, complaint in ((empty, "server.api_key"), (tmp_path / "none", "No such file")):
        with pytest.raises(SystemExit) as caught:
            main(["maps", "list", "--api-key-file", str(path)])
        assert caught.value.code == 1
        assert complaint in capsys.readouterr().err


@pytest.mark.parametrize(
    ("status", "kind", "code"),
    [
        (401, Unauthenticated, "request.unauthenticated"),
        (403, Forbidden, "request.forbidden"),
    ],
)
def test_a_proxy_that_refuses_is_told_apart(
    status: int, kind: type[VislocError], code: str, answering: Any
) -> None:
    with Client(answering(status, b"no")) as client, pytest.raises(kind) as caught:
        client.maps()
    assert caught.value.code == code


@pytest.mark.parametrize(
    ("kind", "status", "code"),
    [
        (Unauthenticated, 401, "access.key_unknown"),
        (Forbidden, 403, "access.scope"),
        (TimedOut, 504, "request.too_slow"),
    ],
)
def test_a_refusal_comes_as_the_server_raised_it(
    kind: type[VislocError], status: int, code: str, answering: Any
) -> None:
    problem = {"kind": kind.__name__, "code": code, "detail": "no", "status": status}
    url = answering(status, json.dumps(problem).encode())
    with Client(url) as client, pytest.raises(kind) as caught:
        client.maps()
    assert type(caught.value) is kind
    assert caught.value.code == code


@pytest.fixture
def answering() -> Iterator[Any]:
    """A server with one answer to everything."""
    running: list[tuple[ThreadingHTTPServer, threading.Thread]] = []

    def start(status: int, body: bytes) -> str:
        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.send_response(status)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *_: Any) -> None:
                pass

        server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        running.append((server, thread))
        return f"http://127.0.0.1:{server.server_port}"

    yield start
    for server, thread in running:
        server.shutdown()
        thread.join()
        server.server_close()
