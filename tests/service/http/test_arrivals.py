from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import httpx
import pytest
import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route

from service.http.arrivals import Arrivals
from service.http.responses import problem_response
from service.settings import SLOWEST_BYTES_PER_S
from visloc.errors import VislocError

GRACE_S = 0.6
LIMIT = 200_000
BUDGET = 300_000


async def read(request: Request) -> Response:
    arrivals: Arrivals = request.app.state.arrivals
    try:
        async with arrivals.body(request, LIMIT) as body:
            return PlainTextResponse(f"{len(body)} {arrivals.bytes_held}")
    except VislocError as error:
        return problem_response(error, "the-id")


@pytest.fixture(scope="module")
def server() -> Iterator[tuple[int, Arrivals]]:
    arrivals = Arrivals(GRACE_S, BUDGET)
    app = Starlette(routes=[Route("/read", read, methods=["POST"])])
    app.state.arrivals = arrivals
    running = uvicorn.Server(uvicorn.Config(app, port=0, log_level="critical", lifespan="off"))
    thread = threading.Thread(target=running.run)
    thread.start()
    while not running.started:
        time.sleep(0.01)
    yield running.servers[0].sockets[0].getsockname()[1], arrivals
    running.should_exit = True
    thread.join()


@contextmanager
def connected(port: int) -> Iterator[socket.socket]:
    with socket.create_connection(("127.0.0.1", port), timeout=10) as connection:
        yield connection


def one_answer(connection: socket.socket) -> bytes:
    """One whole answer, and nothing after it."""
    got = b""
    while b"\r\n\r\n" not in got:
        got += connection.recv(1)
    size = int(got.lower().partition(b"content-length: ")[2].split(b"\r\n")[0])
    body = b""
    while len(body) < size:
        body += connection.recv(size - len(body))
    return got + body


def dribble(connection: socket.socket, data: bytes, every_s: float = GRACE_S / 12) -> bool:
    """Send one byte after the other; return whether all were taken."""
    try:
        for i in range(len(data)):
            connection.sendall(data[i : i + 1])
            time.sleep(every_s)
    except OSError:
        return False  # it was closed
    return True


def head(path: str, size: int) -> bytes:
    return f"POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Length: {size}\r\n\r\n".encode()


def wait_until_idle(arrivals: Arrivals) -> None:
    for _ in range(200):
        if arrivals.bytes_held == 0:
            return
        time.sleep(0.01)
    pytest.fail(f"{arrivals.bytes_held} bytes are still held")


def test_a_body_that_comes_byte_by_byte_is_refused_and_costs_nothing_more(
    server: tuple[int, Arrivals],
) -> None:
    port, arrivals = server
    with connected(port) as connection:
        connection.sendall(head("/read", 100_000))
        with ThreadPoolExecutor(1) as pool:
            taken = pool.submit(dribble, connection, b"x" * 1000)
            got = one_answer(connection)
            # The rest of the body does not keep the connection.
            assert not taken.result()
        assert b" 504 " in got
        assert b'"code":"request.too_slow"' in got
    wait_until_idle(arrivals)


def test_a_body_that_is_slow_but_comes_is_read(server: tuple[int, Arrivals]) -> None:
    size = round(SLOWEST_BYTES_PER_S * 1.5)  # which has a second and a half more
    with connected(server[0]) as connection:
        connection.sendall(head("/read", size))
        for _ in range(10):
            connection.sendall(b"x" * (size // 10))
            time.sleep(0.12)
        assert one_answer(connection).endswith(f"{size} {size}".encode())


@pytest.mark.parametrize("chunked", [False, True])
def test_too_large_a_body_is_refused_before_it_is_read(
    server: tuple[int, Arrivals], chunked: bool
) -> None:
    body = b"x" * (LIMIT + 1)
    content: Any = iter([body[:1000], body[1000:]]) if chunked else body
    answer = httpx.post(f"http://127.0.0.1:{server[0]}/read", content=content)

    assert answer.status_code == 413
    assert answer.json()["code"] == "request.too_large"
    assert server[1].bytes_held == 0


@pytest.mark.parametrize("size", [2**63, 2**64 - 1, 10**19])
def test_however_large_a_length_is_it_is_refused_before_any_of_it_comes(
    server: tuple[int, Arrivals], size: int
) -> None:
    with connected(server[0]) as connection:
        connection.sendall(head("/read", size))
        assert b'"code":"request.too_large"' in one_answer(connection)


def test_together_bodies_take_no_more_than_there_is_room_for(
    server: tuple[int, Arrivals],
) -> None:
    port, arrivals = server
    half = b"x" * 100_000
    with connected(port) as first, connected(port) as second, connected(port) as third:
        for connection in (first, second):
            connection.sendall(head("/read", 150_000) + half)
        while arrivals.bytes_held < 200_000:
            time.sleep(0.01)
        third.sendall(head("/read", 150_000) + b"x" * 150_000)
        assert b'"code":"server.busy"' in one_answer(third)
        first.sendall(b"x" * 50_000)
        assert one_answer(first).endswith(b"150000 250000")
    wait_until_idle(arrivals)


def test_a_client_that_leaves_gives_back_what_it_held(server: tuple[int, Arrivals]) -> None:
    port, arrivals = server
    with connected(port) as connection:
        connection.sendall(head("/read", 150_000) + b"x" * 100_000)
        while arrivals.bytes_held == 0:
            time.sleep(0.01)
    wait_until_idle(arrivals)
