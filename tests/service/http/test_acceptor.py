"""Floods of idle connections, over both APIs, on real sockets."""

from __future__ import annotations

import asyncio
import errno
import logging
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import grpc
import httpx
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc

from service.http.acceptor import Acceptor, Connection, OpenConnections
from tests.service.security.test_tls import make_certificate

LIMIT = 20
PROBED = ("/healthz", "/openapi.json")


@contextmanager
def idle(port: int, count: int) -> Iterator[list[socket.socket]]:
    """Hold so many connections that say nothing."""
    with ExitStack() as stack:
        address = ("127.0.0.1", port)
        yield [stack.enter_context(socket.create_connection(address, 10)) for _ in range(count)]


@contextmanager
def begun(port: int) -> Iterator[socket.socket]:
    """A request of which the last byte has not been sent."""
    with socket.create_connection(("127.0.0.1", port), 10) as connection:
        head = (
            "POST /localize/rig HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
        )
        connection.sendall(f"{head}Content-Length: 2\r\n\r\n".encode() + b"[")
        yield connection


def status(connection: socket.socket) -> int:
    return int(connection.recv(65536).split(b" ", 2)[1])


def open_files() -> int:
    return len(list(Path("/dev/fd").iterdir()))


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def gone(connection: socket.socket) -> bool:
    """Whether the server closed a connection."""
    connection.setblocking(False)
    try:
        while connection.recv(65536):
            pass
    except BlockingIOError:
        return False
    except ConnectionError:
        pass
    return True


def test_idle_connections_leave_room_and_the_longest_idle_is_closed(
    serve: Any, tmp_path: Path
) -> None:
    with serve(tmp_path, load=False, max_connections=LIMIT) as doors, ExitStack() as stack:
        port = doors.server.http_port
        under_way = [stack.enter_context(begun(port)) for _ in range(3)]
        wait_until(lambda: doors.server.state().connections == 3)
        before = open_files()
        first = stack.enter_context(idle(port, LIMIT))
        last = stack.enter_context(idle(port, 4 * LIMIT))

        for path in PROBED * 5:
            assert httpx.get(f"{doors.url}{path}").status_code == 200
        assert doors.server.state().connections <= LIMIT
        # One end of each connection is this test's own.
        assert open_files() <= before + 5 * LIMIT + LIMIT
        assert all(gone(each) for each in first)
        assert not gone(last[-1])
        for each in under_way:
            each.sendall(b"]")
            assert status(each) == 422


def test_metrics_on_their_own_port_withstand_it_too(serve: Any, tmp_path: Path) -> None:
    with (
        serve(tmp_path, load=False, max_connections=LIMIT, metrics_port=0) as doors,
        idle(doors.server.metrics_port, 100),
    ):
        url = f"http://127.0.0.1:{doors.server.metrics_port}/metrics"
        assert all(httpx.get(url).status_code == 200 for _ in range(5))


def test_silence_within_the_handshake_of_tls_is_idle_too(serve: Any, tmp_path: Path) -> None:
    certificate, key = make_certificate(tmp_path)
    files = {"tls_cert": certificate, "tls_key": key}
    with (
        serve(tmp_path, load=False, max_connections=LIMIT, **files) as doors,
        idle(doors.server.http_port, 3 * LIMIT) as silent,
    ):
        url = f"https://127.0.0.1:{doors.server.http_port}/healthz"
        assert all(httpx.get(url, verify=False).status_code == 200 for _ in range(3))
        assert sum(gone(each) for each in silent) >= 2 * LIMIT
        assert doors.server.state().connections <= LIMIT


def test_requests_that_do_not_arrive_leave_room_for_others(serve: Any, tmp_path: Path) -> None:
    with serve(tmp_path, load=False, max_connections=LIMIT) as doors, ExitStack() as stack:
        under_way = [stack.enter_context(begun(doors.server.http_port)) for _ in range(3 * LIMIT)]
        for path in ("/healthz", "/metrics", "/maps"):
            assert httpx.get(f"{doors.url}{path}").is_success
        assert doors.server.state().connections <= LIMIT
        assert all(gone(each) for each in under_way[:LIMIT])
        last = under_way[-1]
        last.setblocking(True)
        last.sendall(b"]")
        assert status(last) == 422


def answers(stub: Any) -> bool:
    """Whether health is told; a connection may meet the moment in which all places are taken."""
    try:
        stub.Check(health_pb2.HealthCheckRequest(), timeout=10)
    except grpc.RpcError as error:
        if error.code() is not grpc.StatusCode.UNAVAILABLE:
            raise
        return False
    return True


def test_idle_connections_of_grpc_leave_room_for_calls(serve: Any, tmp_path: Path) -> None:
    with (
        serve(tmp_path, load=False, max_connections=LIMIT) as doors,
        ExitStack() as stack,
    ):
        watch = health_pb2_grpc.HealthStub(doors.channel).Watch(health_pb2.HealthCheckRequest())
        assert next(watch).status == health_pb2.HealthCheckResponse.NOT_SERVING
        port = doors.server.grpc_port
        silent = stack.enter_context(idle(port, 5 * LIMIT))
        wait_until(lambda: sum(gone(each) for each in silent) >= 4 * LIMIT + LIMIT // 4)

        for _ in range(3):
            options = [("grpc.use_local_subchannel_pool", 1)]
            with grpc.insecure_channel(f"127.0.0.1:{port}", options) as channel:
                wait_until(partial(answers, health_pb2_grpc.HealthStub(channel)))
        assert watch.is_active()
        watch.cancel()


# Without a service


class Talk(Connection):
    """A connection of which the test says whether it sends."""

    def __init__(self) -> None:
        self.sends = False
        self.was_closed = False
        self.was_made = asyncio.Event()
        self.transport: asyncio.BaseTransport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = transport
        self.was_made.set()

    @property
    def is_sending(self) -> bool:
        return self.sends

    def abandon(self) -> None:
        self.was_closed = True
        if self.transport is not None:
            self.transport.close()


def test_who_is_closed_for_another(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.http.acceptor._LEAST_IDLE_S", 0.0)
    talks = [Talk() for _ in range(4)]
    using, sending, waiting, answered = talks
    connections = OpenConnections(4)
    for talk in (answered, using, sending, waiting):
        connections.add(talk)
    for talk in (using, answered):
        connections.note(talk, in_use=True)
    connections.note(answered, in_use=False)
    sending.sends = True

    assert connections.make_room() == 0
    assert [talk.was_closed for talk in talks] == [False, False, True, False]
    newest = Talk()
    connections.add(newest)
    assert connections.make_room() == 0
    assert newest.was_closed  # it has asked nothing, as most that are idle
    assert not answered.was_closed
    for talk in talks:
        connections.remove(talk)
    assert len(connections) == 0


def test_the_longest_idle_of_the_kind_that_has_more_is_closed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("service.http.acceptor._LEAST_IDLE_S", 0.0)
    answered, silent = [Talk() for _ in range(4)], [Talk() for _ in range(6)]
    connections = OpenConnections(10)
    for talk in answered:
        connections.add(talk)
        connections.note(talk, in_use=True)
        connections.note(talk, in_use=False)
    for talk in silent:
        connections.add(talk)

    for _ in range(2):  # those that never asked give way to others that have not yet
        assert connections.make_room() == 0
        connections.add(Talk())
    assert [talk.was_closed for talk in silent] == [True, True, False, False, False, False]
    assert not any(talk.was_closed for talk in answered)

    for talk in silent[2:5]:  # more have been answered now, and hold their places
        connections.note(talk, in_use=True)
        connections.note(talk, in_use=False)
    assert connections.make_room() == 0
    assert [talk.was_closed for talk in answered] == [True, False, False, False]


def test_a_request_that_does_not_come_on_is_closed_when_none_is_idle(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("service.http.acceptor._LEAST_IDLE_S", 0.0)
    fast, slow, using, silent = talks = [Talk() for _ in range(4)]
    connections = OpenConnections(4)
    for talk in talks:
        connections.add(talk)
    for talk in (fast, slow, using):
        connections.note(talk, in_use=False, arriving=True)
    connections.note(using, in_use=True)
    connections.renew(fast)
    connections.renew(silent)  # which brings nothing new

    for closed in ([silent], [silent, slow], [silent, slow, fast]):
        assert connections.make_room() == 0
        assert [talk for talk in talks if talk.was_closed] == sorted(closed, key=talks.index)
        another = Talk()
        connections.add(another)
        connections.note(another, in_use=True)
    assert connections.make_room() == float("inf")


def test_bodies_that_hold_most_places_give_way_before_those_between_two_requests() -> None:
    answered, *slow = [Talk() for _ in range(5)]
    connections = OpenConnections(5)
    connections.add(answered)
    for talk in slow:
        connections.add(talk)
        connections.note(talk, in_use=False, arriving=True)
    time.sleep(2 * connections.make_room())  # a body that has just begun has its time too

    for closed in (slow[:1], slow[:2]):
        assert connections.make_room() == 0
        assert [talk for talk in slow if talk.was_closed] == closed
        connections.add(Talk())  # its head has not been read: nobody waits for it
    assert connections.make_room() == 0
    assert answered.was_closed  # bodies are the fewer now
    assert not any(talk.was_closed for talk in slow[2:])


def test_a_new_connection_has_time_to_send_a_request() -> None:
    connections = OpenConnections(1)
    new = Talk()
    connections.add(new)
    assert 0 < connections.make_room() <= 0.1
    assert not new.was_closed

    connections.note(new, in_use=True)
    assert connections.make_room() == float("inf")


def test_who_was_served_is_not_closed_because_new_ones_have_their_time_yet() -> None:
    served, *new = [Talk() for _ in range(3)]
    connections = OpenConnections(3)
    connections.add(served)
    connections.note(served, in_use=True)
    connections.note(served, in_use=False)
    time.sleep(0.15)
    for talk in new:
        connections.add(talk)

    wait_s = connections.make_room()
    assert 0 < wait_s < 1
    assert not served.was_closed
    time.sleep(wait_s)
    assert connections.make_room() == 0
    assert new[0].was_closed


def test_a_small_limit_has_a_place_for_health_too() -> None:
    connections = OpenConnections(3)
    for _ in range(2):
        talk = Talk()
        connections.add(talk)
        connections.note(talk, in_use=True)
    assert not connections.is_busy
    talk = Talk()
    connections.add(talk)
    connections.note(talk, in_use=True)
    assert connections.is_busy


class Listener(socket.socket):
    """A socket that cannot accept, the first times."""

    failures = 3
    error = OSError(errno.EMFILE, "Too many open files")

    def accept(self) -> tuple[socket.socket, Any]:
        if self.failures:
            self.failures -= 1
            raise self.error
        return super().accept()


def test_an_error_of_one_connection_is_not_that_of_the_next(
    caplog: pytest.LogCaptureFixture,
) -> None:
    connections, old, new = OpenConnections(10), Talk(), Talk()
    connections.add(old)

    async def run() -> None:
        with Listener() as listener:
            listener.error = OSError(errno.EHOSTUNREACH, "No route to host")
            listener.bind(("127.0.0.1", 0))
            listener.listen()
            acceptor = Acceptor(listener, connections, lambda: new, None, 1.0)
            with socket.create_connection(listener.getsockname()):
                await asyncio.wait_for(new.was_made.wait(), 10)
            acceptor.close()
            new.abandon()

    asyncio.run(run())
    assert not old.was_closed
    assert not caplog.records


def test_at_the_end_all_are_taken_in_who_have_connected() -> None:
    connections, made = OpenConnections(300), []

    def make() -> Talk:
        made.append(Talk())
        return made[-1]

    async def run() -> None:
        with socket.create_server(("127.0.0.1", 0), backlog=256) as listener, ExitStack() as stack:
            acceptor = Acceptor(listener, connections, make, None, 1.0)
            for _ in range(150):  # more than one turn of the event loop takes
                stack.enter_context(socket.create_connection(listener.getsockname()))
            acceptor.close()
            await asyncio.gather(*(asyncio.wait_for(each.was_made.wait(), 10) for each in made))
            for each in made:
                each.abandon()

    asyncio.run(run())
    assert len(made) == 150


def test_without_descriptors_it_waits_closes_idle_ones_and_says_so_once(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.http.acceptor._EPISODE_S", 0.3)
    caplog.set_level(logging.INFO)
    connections, old, new = OpenConnections(10), Talk(), Talk()
    connections.add(old)

    async def run() -> None:
        with Listener() as listener:
            listener.bind(("127.0.0.1", 0))
            listener.listen()
            acceptor = Acceptor(listener, connections, lambda: new, None, 1.0)
            with socket.create_connection(listener.getsockname()):
                await asyncio.wait_for(new.was_made.wait(), 10)
                await asyncio.sleep(0.5)
            acceptor.close()
            new.abandon()

    asyncio.run(run())
    assert old.was_closed
    assert [record.levelname for record in caplog.records] == ["ERROR", "WARNING"]
    assert "Too many open files" in caplog.messages[0]
