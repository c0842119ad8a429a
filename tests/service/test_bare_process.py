"""What a service without a proxy in front of it holds to (docs/operations.md, connections)."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import grpc
import httpx
import pytest

from visloc_api.v1 import localization_pb2 as pb2
from visloc_api.v1.localization_pb2_grpc import LocalizationStub

LIMIT = 20
HOST = b"Host: localhost\r\n"
CHUNKED = b"POST /localize HTTP/1.1\r\n" + HOST + b"Transfer-Encoding: chunked\r\n\r\n"


@pytest.fixture(scope="module")
def bare(serve: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A service without maps."""
    with serve(tmp_path_factory.mktemp("maps"), load=False) as doors:
        yield doors


@contextmanager
def silent(port: int, count: int) -> Iterator[list[socket.socket]]:
    """Connections that say nothing."""
    with ExitStack() as stack:
        address = ("127.0.0.1", port)
        yield [stack.enter_context(socket.create_connection(address, 10)) for _ in range(count)]


def begin_request(port: int) -> socket.socket:
    """A request without the last byte of its body."""
    connection = socket.create_connection(("127.0.0.1", port), 10)
    head = "POST /localize/rig HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
    connection.sendall(f"{head}Content-Length: 2\r\n\r\n[".encode())
    return connection


def wait_until(is_so: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60
    while not is_so():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def is_closed(connection: socket.socket) -> bool:
    connection.setblocking(False)
    try:
        while connection.recv(65536):
            pass
    except BlockingIOError:
        return False
    except ConnectionError:
        pass
    return True


def test_connections_beyond_the_limit_are_closed_until_others_leave(
    serve: Any, tmp_path: Path
) -> None:
    with serve(tmp_path, load=False, max_connections=LIMIT) as doors:
        with silent(doors.server.http_port, 2 * LIMIT) as connections:
            wait_until(lambda: sum(map(is_closed, connections)) == LIMIT)
            assert doors.server.state().connections == LIMIT
            assert not any(is_closed(each) for each in connections[:LIMIT])
        wait_until(lambda: doors.server.state().connections == 0)
        assert doors.http.get("/healthz").is_success


def test_requests_beyond_the_limit_are_refused_and_probes_answered(
    serve: Any, tmp_path: Path
) -> None:
    with serve(tmp_path, load=False, max_connections=LIMIT) as doors, ExitStack() as stack:
        running = [
            stack.enter_context(begin_request(doors.server.http_port)) for _ in range(LIMIT - 2)
        ]
        text = "visloc_requests_in_progress"
        wait_until(lambda: f'{text}{{door="http"}} {LIMIT - 1}' in doors.http.get("/metrics").text)

        refused = doors.http.get("/maps")
        assert (refused.status_code, refused.json()["code"]) == (429, "server.busy")
        assert doors.http.get("/healthz").is_success
        for each in running:
            each.sendall(b"]")
            assert each.recv(65536).startswith(b"HTTP/1.1 422 ")
        assert doors.http.get("/maps").is_success


def test_an_answer_that_is_not_taken_does_not_keep_its_connection(
    serve: Any, tmp_path: Path
) -> None:
    with serve(tmp_path, load=False, arrival_timeout_s=0.5) as doors, socket.socket() as client:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        client.connect(("127.0.0.1", doors.server.http_port))
        client.sendall((b"GET /openapi.json HTTP/1.1\r\n" + HOST + b"\r\n") * 40)
        wait_until(lambda: doors.server.state().connections == 1)
        wait_until(lambda: doors.server.state().connections == 0)


def test_silent_connections_of_grpc_are_closed_after_a_while(serve: Any, tmp_path: Path) -> None:
    options = (("grpc.use_local_subchannel_pool", 1),)
    with serve(tmp_path, load=False, max_connections=LIMIT, arrival_timeout_s=0.5) as doors:
        port = doors.server.grpc_port
        with silent(port, LIMIT) as connections:
            wait_until(lambda: all(map(is_closed, connections)))
            with grpc.insecure_channel(f"127.0.0.1:{port}", options) as channel:
                stub = LocalizationStub(channel)
                assert stub.ListMaps(pb2.ListMapsRequest(), wait_for_ready=True, timeout=20)


def test_a_connection_of_grpc_without_calls_is_closed_and_opened_again(
    serve: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.grpc.server._IDLE_MS", 200)
    states = list[grpc.ChannelConnectivity]()
    with serve(tmp_path, load=False) as doors:
        doors.channel.subscribe(states.append)
        assert doors.stub.ListMaps(pb2.ListMapsRequest()).maps == []
        wait_until(lambda: states[-1] is grpc.ChannelConnectivity.IDLE)
        assert doors.stub.ListMaps(pb2.ListMapsRequest()).maps == []


@pytest.mark.parametrize(
    "sent",
    [
        b"\0",
        bytes(range(256)) * 300,
        b"SSH-2.0-OpenSSH_9.2\r\n\r\n",
        b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\4\0\0\0\0\0",
        bytes.fromhex("16030100c8010000c40303") + bytes(200),
        b"GET /\xff\0 HTTP/1.1\r\n" + HOST + b"\r\n",
        b"GET / HTTP/1.1\r\n" + HOST + b"X: " + b"a" * 100_000,
        b"HEAD / HTTP/1.1\r\n" + HOST + b"Transfer-Encoding: chunked\r\n\r\nzz\r\n",
        b"POST / HTTP/1.1\r\n" + HOST + b"Content-Length: -1\r\n\r\n",
        b"POST / HTTP/1.1\r\n" + HOST + b"Content-Length: 2\r\nContent-Length: 3\r\n\r\nab",
        CHUNKED + b"zz\r\n",
        CHUNKED + b"f" * 20 + b"\r\n",
        CHUNKED + b"0" * 70_000,
        CHUNKED + b"1\r\nx\r\n" * 2_000,
        CHUNKED + b"0\r\n\r\nGARBAGE\r\n\r\n",
    ],
)
@pytest.mark.parametrize("door", ["http", "grpc"])
def test_bytes_that_are_no_request_leave_the_service_as_it_was(
    door: str, sent: bytes, bare: Any
) -> None:
    port = bare.server.http_port if door == "http" else bare.server.grpc_port
    with socket.create_connection(("127.0.0.1", port), 10) as connection, suppress(OSError):
        connection.sendall(sent)
        connection.shutdown(socket.SHUT_WR)
        connection.settimeout(0.2)
        connection.recv(65536)
    with httpx.Client(base_url=bare.url, timeout=60) as http:
        assert http.get("/healthz").is_success
    assert bare.stub.ListMaps(pb2.ListMapsRequest()).maps == []


def test_a_head_that_is_too_long_is_refused(bare: Any) -> None:
    with socket.create_connection(("127.0.0.1", bare.server.http_port), 10) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\n" + HOST + b"X: " + b"a" * 17_000)
        assert connection.recv(65536).startswith(b"HTTP/1.1 400 ")
