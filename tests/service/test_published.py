"""The service as compose publishes it: behind HAProxy, which faces slow and hostile clients."""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import socket
from collections.abc import Iterator

import httpx
import pytest

from benchmarks.reliability.attackers import Assault, attacked
from benchmarks.reliability.replicas import Balanced, balanced
from tests.service.test_replicas import accepted

pytestmark = pytest.mark.skipif(
    shutil.which("haproxy") is None,
    reason="needs HAProxy; on Debian and Ubuntu `make balancer`, as root, installs it",
)

HEAD = b"POST /localize HTTP/1.1\r\nHost: localhost\r\n"
SLOW = ("send a head, a byte a second", "send a body, a byte a second", "send no HTTP")


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Balanced]:
    """One replica without maps, and HAProxy before it."""
    work = tmp_path_factory.mktemp("published")
    (work / "maps").mkdir()
    with balanced([work / "maps"], work) as found:
        yield found


@pytest.fixture
def published(running: Balanced) -> Balanced:
    """The same, whatever the test before did to the replica."""
    (replica,) = running.replicas
    if not replica.is_ready():
        replica.start()
        replica.wait_until_ready()
        running.wait_until_serving(1)
    return running


def problem(answer: httpx.Response, status: int) -> str:
    assert answer.status_code == status
    assert answer.headers["content-type"] == "application/problem+json"
    found = answer.json()
    assert found["status"] == status
    assert found["request_id"]
    return str(found["code"])


def test_requests_that_do_not_come_never_reach_the_service(published: Balanced) -> None:
    front = published.front
    assaults = [Assault(name, front.http_port, 30, source="127.0.0.2") for name in SLOW]
    message = "send a message, a byte a second"
    assaults.append(Assault(message, front.grpc_port, 30, source="127.0.0.2"))

    async def attack() -> list[float]:
        async with attacked(assaults):
            await asyncio.sleep(1)
            return [
                httpx.get(f"{published.http}/maps").status_code,
                accepted(published.replicas[0]),
                published.replicas[0].log.read_text().count("/localize"),
            ]

    assert asyncio.run(attack()) == [200, 0, 0]


def test_a_request_is_answered_when_its_body_has_come(published: Balanced) -> None:
    head = HEAD + b"Content-Type: application/json\r\nContent-Length: 2\r\n\r\n"
    with socket.create_connection(("127.0.0.1", published.front.http_port), 10) as connection:
        connection.sendall(head + b"[")
        connection.settimeout(0.3)
        with pytest.raises(TimeoutError):
            connection.recv(1)
        connection.settimeout(10)
        connection.sendall(b"]")
        assert connection.recv(65536).startswith(b"HTTP/1.1 422 ")


@pytest.mark.parametrize(
    "sent",
    [
        HEAD + b"Transfer-Encoding: chunked\r\n\r\nzz\r\n",
        HEAD + b"Content-Length: 2\r\nContent-Length: 3\r\n\r\nab",
        b"GET /\0 HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET /maps HTTP/1.1\r\nHost: localhost\r\nX : a\r\n\r\n",
        b"GET /maps HTTP/1.1\r\nX: " + b"a" * 20_000 + b"\r\n\r\n",
    ],
)
def test_bytes_that_are_no_request_are_refused_before_the_service(
    published: Balanced, sent: bytes
) -> None:
    before = published.replicas[0].log.read_text()
    with socket.create_connection(("127.0.0.1", published.front.http_port), 10) as connection:
        connection.sendall(sent)
        assert connection.recv(65536).startswith(b"HTTP/1.1 400 ")
    assert published.replicas[0].log.read_text() == before


@pytest.mark.parametrize("headers", [{}, {"Expect": "100-continue"}])
def test_a_body_that_is_too_large_is_answered_with_the_limit(
    published: Balanced, headers: dict[str, str]
) -> None:
    json = {"Content-Type": "application/json", **headers}
    answer = httpx.post(f"{published.http}/localize", content=bytes(40_000_000), headers=json)

    assert problem(answer, 413) == "request.too_large"


def test_while_no_replica_is_ready_the_service_says_why(published: Balanced) -> None:
    (replica,) = published.replicas
    os.kill(replica.pid, signal.SIGTERM)  # for some seconds it is only not ready
    published.wait_until_serving(0)

    answer = httpx.get(f"{published.http}/readyz")
    assert (answer.status_code, answer.json()["ready"]) == (503, False)
    assert httpx.get(f"{published.http}/healthz").is_success
    replica.stop()
    assert problem(httpx.get(f"{published.http}/maps", timeout=30), 503) == "server.unavailable"
