from __future__ import annotations

import asyncio
import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

import h11
import httpx
import pytest
import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route
from uvicorn.server import ServerState

from service.http.acceptor import Acceptor, OpenConnections
from service.http.responses import problem_response
from service.http.slow_clients import Arrivals, LargeChunks, http_protocol
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


async def refuse(_: Request) -> Response:
    return PlainTextResponse("no", 403)


async def long(_: Request) -> Response:
    return Response(b"x" * 20_000_000)


async def small(_: Request) -> Response:
    return Response(b"x" * 30_000)


@pytest.fixture(scope="module")
def server() -> Iterator[tuple[int, Arrivals]]:
    with serving(GRACE_S) as made:
        yield made


@contextmanager
def serving(grace_s: float) -> Iterator[tuple[int, Arrivals]]:
    arrivals = Arrivals(grace_s, BUDGET)
    methods = ["GET", "POST"]
    routes = [Route(f"/{do.__name__}", do, methods=methods) for do in (read, refuse, long)]
    app = Starlette(routes=routes)
    app.state.arrivals = arrivals
    config = uvicorn.Config(
        app,
        port=0,
        log_level="critical",
        lifespan="off",
        http=http_protocol(grace_s, OpenConnections(1000)),
    )
    running = uvicorn.Server(config)
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


def answer_of(connection: socket.socket) -> bytes:
    """What came until the server closed the connection."""
    parts = []
    try:
        while part := connection.recv(65536):
            parts.append(part)
    except ConnectionResetError:
        pass
    return b"".join(parts)


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


def test_a_head_that_comes_byte_by_byte_is_not_waited_for(server: tuple[int, Arrivals]) -> None:
    started = time.monotonic()
    with connected(server[0]) as connection:
        assert not dribble(connection, b"GET /read HTTP/1.1\r\nHost: " + b"a" * 1000)
        assert time.monotonic() - started >= GRACE_S


@pytest.mark.parametrize("sent", [b"", b"GET"])
def test_a_connection_that_says_nothing_more_is_closed(
    server: tuple[int, Arrivals], sent: bytes
) -> None:
    started = time.monotonic()
    with connected(server[0]) as connection:
        connection.sendall(sent)

        assert answer_of(connection) == b""
        assert time.monotonic() - started >= GRACE_S


def test_the_head_of_a_second_request_is_not_waited_for_either(
    server: tuple[int, Arrivals],
) -> None:
    with connected(server[0]) as connection:
        started = time.monotonic()
        connection.sendall(head("/refuse", 0))
        assert one_answer(connection).endswith(b"no")
        assert not dribble(connection, b"GET /read HTTP/1.1\r\nHost: " + b"a" * 1000)
        assert time.monotonic() - started >= GRACE_S


def test_requests_one_after_the_other_are_not_cut_off(server: tuple[int, Arrivals]) -> None:
    with connected(server[0]) as connection:
        for _ in range(6):  # longer than the time for a head
            connection.sendall(head("/read", 5) + b"hello")
            assert one_answer(connection).endswith(b"5 5")
            time.sleep(GRACE_S / 4)


def test_requests_that_come_in_one_piece_are_all_answered(server: tuple[int, Arrivals]) -> None:
    with connected(server[0]) as connection:
        connection.sendall((head("/read", 5) + b"hello") * 3)
        got = b""
        while got.count(b"5 5") < 3:
            got += connection.recv(65536)
        time.sleep(1.5 * GRACE_S)
        connection.sendall(head("/read", 2) + b"ho")
        assert one_answer(connection).endswith(b"2 2")


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


def test_a_refused_request_whose_body_goes_on_and_on_is_cut_off(
    server: tuple[int, Arrivals],
) -> None:
    with connected(server[0]) as connection:
        connection.sendall(head("/refuse", 10**9))
        assert b" 403 " in one_answer(connection)
        assert not dribble(connection, b"x" * 1000)


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


CHUNKED = b"POST /%b HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n"


@pytest.mark.parametrize("path", [b"read", b"refuse"])
def test_a_body_in_very_many_tiny_chunks_is_not_read(
    server: tuple[int, Arrivals], path: bytes
) -> None:
    with connected(server[0]) as connection:
        connection.sendall(CHUNKED % path)
        if path == b"refuse":  # the answer comes before the body
            assert one_answer(connection).startswith(b"HTTP/1.1 403")
        dribble(connection, b"1\r\nx\r\n" * 50, 0.0)  # which is nothing special
        with suppress(ConnectionError):
            connection.sendall(b"1\r\nx\r\n" * 20_000)
        answer = answer_of(connection)
    assert answer.startswith(b"HTTP/1.1 400") == (path == b"read" and bool(answer))
    wait_until_idle(server[1])


@pytest.mark.parametrize(("number", "size"), [(2000, 1), (2900, 64), (500, 200)])
def test_a_body_in_many_chunks_is_read(
    server: tuple[int, Arrivals], number: int, size: int
) -> None:
    with connected(server[0]) as connection:
        chunk = b"%x\r\n%b\r\n" % (size, b"x" * size)
        connection.sendall(CHUNKED % b"read" + chunk * number + b"0\r\n\r\n")
        assert one_answer(connection).endswith(f"{number * size} {number * size}".encode())


def test_a_body_in_many_packets_is_read() -> None:
    """Of a small device that writes a few bytes at a time."""
    connection = LargeChunks(h11.SERVER)
    connection.receive_data(head("/read", 20_000))
    connection.next_event()
    for _ in range(5000):
        connection.receive_data(b"1234")
        event = connection.next_event()
        assert isinstance(event, h11.Data)
        assert bytes(event.data) == b"1234"


def test_what_is_no_http_after_an_answer_leaves_no_traceback(
    server: tuple[int, Arrivals], caplog: pytest.LogCaptureFixture
) -> None:
    with connected(server[0]) as connection:
        connection.sendall(CHUNKED % b"refuse")
        assert one_answer(connection).startswith(b"HTTP/1.1 403")
        connection.sendall(b"this is no chunk\r\n\r\n")
        assert not answer_of(connection)
    assert not caplog.records


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


def test_too_long_a_head_is_refused_even_when_it_comes_at_once(
    server: tuple[int, Arrivals],
) -> None:
    with connected(server[0]) as connection:
        connection.sendall(b"GET /read HTTP/1.1\r\nHost: a\r\nX: " + b"x" * 17_000 + b"\r\n\r\n")
        assert answer_of(connection).startswith(b"HTTP/1.1 400 ")


def test_a_client_that_leaves_gives_back_what_it_held(server: tuple[int, Arrivals]) -> None:
    port, arrivals = server
    with connected(port) as connection:
        connection.sendall(head("/read", 150_000) + b"x" * 100_000)
        while arrivals.bytes_held == 0:
            time.sleep(0.01)
    wait_until_idle(arrivals)


def test_an_answer_that_is_not_taken_is_given_up(
    server: tuple[int, Arrivals], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.http.slow_clients.SLOWEST_BYTES_PER_S", 1e9)
    with connected(server[0]) as connection:
        connection.sendall(b"GET /long HTTP/1.1\r\nHost: localhost\r\n\r\n")
        time.sleep(3 * GRACE_S)
        assert len(answer_of(connection)) < 20_000_000


def test_what_is_left_of_small_answers_is_given_up_too() -> None:
    """Less waits than what asyncio itself takes for a buffer that is full."""
    connections = OpenConnections(10)
    config = uvicorn.Config(
        Starlette(routes=[Route("/small", small)]),
        log_level="critical",
        http=http_protocol(GRACE_S, connections),
    )
    config.load()

    def make() -> Any:
        return config.http_protocol_class(  # type: ignore[call-arg]
            config=config, server_state=ServerState(), app_state={}
        )

    async def run() -> None:
        with socket.create_server(("127.0.0.1", 0)) as listener, socket.socket() as client:
            acceptor = Acceptor(listener, connections, make, None, GRACE_S)
            client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
            client.connect(listener.getsockname())
            async with asyncio.timeout(20):
                while not (opened := list(connections._open)) or not opened[0].is_sending:
                    client.send(b"GET /small HTTP/1.1\r\nHost: localhost\r\n\r\n")
                    await asyncio.sleep(0.002)
                while len(connections):
                    await asyncio.sleep(0.01)
            acceptor.close()

    asyncio.run(run())


def test_an_answer_that_is_taken_slowly_comes_whole(server: tuple[int, Arrivals]) -> None:
    with connected(server[0]) as connection:
        connection.sendall(b"GET /long HTTP/1.1\r\nHost: localhost\r\n\r\n")
        got = 0
        started = time.monotonic()
        while got < 20_000_000:
            part = connection.recv(1_000_000)
            assert part
            got += len(part)
            time.sleep(0.02)
        assert time.monotonic() - started > 0.3


def test_two_hundred_that_have_said_nothing_yet_do_not_hold_up_the_others() -> None:
    with serving(600) as (port, _), ExitStack() as silent:
        for _ in range(200):
            silent.enter_context(connected(port)).sendall(b"POST /read HT")
        url = f"http://127.0.0.1:{port}/read"
        assert httpx.post(url, content=b"x" * 1000, timeout=60).is_success
