"""Connections that say nothing, while health and metrics are asked over new ones."""

from __future__ import annotations

import asyncio
import resource
import socket
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Self

import grpc
import httpx
from grpc_health.v1 import health_pb2
from grpc_health.v1.health_pb2_grpc import HealthStub

from benchmarks.reliability.checks import Check
from benchmarks.reliability.service_process import ServiceProcess, free_port

PROBES = 10
PROBED_S = 5.0
MOST_LOG_LINES = 50
# What each probe must be answered within.
LIMIT_S = 1.0


@dataclass(frozen=True)
class Siege:
    """One attack.

    Attributes:
        api: ``HTTP`` or ``gRPC``, to which the connections go.
        connections: how many.
        limit: of the service's open files, as a shell sets it.
        renewed: whether those that the service closes are opened again, every second.
    """

    api: str
    connections: int
    limit: str
    renewed: bool = False

    def __str__(self) -> str:
        renewed = ", opened again when they are closed" if self.renewed else ""
        limit = self.limit or "no limit set"
        return f"{self.connections} idle connections to {self.api}{renewed}, {limit}"


def sieges(connections: int) -> list[Siege]:
    """The attacks, of so many connections each; where no limit is set, of more."""
    soft, hard = "ulimit -Sn 1024", "ulimit -n 1024"
    return [
        *(Siege(api, connections, limit) for limit in (soft, hard) for api in ("HTTP", "gRPC")),
        Siege("HTTP", connections * 12 // 5, ""),
        Siege("HTTP", connections, soft, renewed=True),
    ]


async def idle_connections(maps_dir: Path, work: Path, connections: int) -> list[Check]:
    """Ask a besieged service for its health and its metrics, over a new connection each time."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    return [
        check
        for number, siege in enumerate(sieges(connections))
        for check in await _withstood(siege, maps_dir, work / f"service-{number}.log")
    ]


async def _withstood(siege: Siege, maps_dir: Path, log: Path) -> list[Check]:
    metrics_port = free_port()
    before = ["bash", "-c", f'{siege.limit}\nexec "$@"', "-"]
    with ServiceProcess(maps_dir, log, before=before, metrics_port=metrics_port) as service:
        port = service.http_port if siege.api == "HTTP" else service.grpc_port
        lines = _lines(log)
        probes: dict[str, Callable[[], Awaitable[None]]] = {
            "/healthz": lambda: _get(f"{service.url}/healthz"),
            "/readyz": lambda: _get(f"{service.url}/readyz"),
            "metrics": lambda: _get(f"http://127.0.0.1:{metrics_port}/metrics"),
            "gRPC health": lambda: _check(service.grpc),
        }
        async with _Besiegers(port, siege) as besiegers:
            found = await asyncio.gather(*(_probed(probe) for probe in probes.values()))
            open_files = len(list(Path(f"/proc/{service.pid}/fd").iterdir()))
        lines = _lines(log) - lines
    answered = {
        name: sum(each < LIMIT_S for each in seconds)
        for name, seconds in zip(probes, found, strict=True)
    }
    slowest = max(each for seconds in found for each in seconds if each < inf)
    # gRPC itself refuses what comes in the moment in which all its places are taken.
    least = {name: PROBES - (siege.api == "gRPC" and name == "gRPC health") for name in probes}
    but = "" if siege.api == "HTTP" else f" (gRPC health: {least['gRPC health']})"
    return [
        Check(
            f"{siege}: {PROBES} probes in {PROBED_S:g} s are answered within {LIMIT_S:g} s{but}",
            ", ".join(f"{name} {count}" for name, count in answered.items())
            + f"; slowest {slowest:.2f} s; {open_files} open files"
            + (f"; {besiegers.closed} were closed" if siege.renewed else ""),
            all(answered[name] >= least[name] for name in probes),
        ),
        Check(f"{siege}: at most {MOST_LOG_LINES} log lines", f"{lines}", lines <= MOST_LOG_LINES),
    ]


def _lines(log: Path) -> int:
    return log.read_bytes().count(b"\n")


async def _probed(probe: Callable[[], Awaitable[None]]) -> list[float]:
    """Ask ten times; the seconds that each took, infinity for what failed."""
    found = []
    for _ in range(PROBES):
        started = time.monotonic()
        try:
            await probe()
        except (httpx.HTTPError, grpc.RpcError):
            found.append(inf)
        else:
            found.append(time.monotonic() - started)
        await asyncio.sleep(max(0.0, started + PROBED_S / PROBES - time.monotonic()))
    return found


async def _get(url: str) -> None:
    async with httpx.AsyncClient(timeout=5) as http:
        (await http.get(url)).raise_for_status()


async def _check(address: str) -> None:
    # A channel of its own, which would otherwise share the connection of the last one.
    options = [("grpc.use_local_subchannel_pool", 1)]
    async with grpc.aio.insecure_channel(address, options=options) as channel:
        await HealthStub(channel).Check(health_pb2.HealthCheckRequest(), timeout=5)


class _Besiegers:
    """So many silent connections to a port, while the block runs.

    Attributes:
        closed: how many the service has closed, where they are renewed.
    """

    def __init__(self, port: int, siege: Siege) -> None:
        self._port = port
        self._siege = siege
        self.closed = 0

    async def __aenter__(self) -> Self:
        self._connections = [_connection(self._port) for _ in range(self._siege.connections)]
        self._renewing = asyncio.create_task(self._renew())
        return self

    async def __aexit__(self, *_: object) -> None:
        self._renewing.cancel()
        for connection in self._connections:
            connection.close()

    async def _renew(self) -> None:
        while self._siege.renewed:
            await asyncio.sleep(1)
            for number, connection in enumerate(self._connections):
                if _is_closed(connection):
                    self.closed += 1
                    connection.close()
                    self._connections[number] = _connection(self._port)
                if number % 100 == 0:
                    await asyncio.sleep(0)  # the probes' turn


def _connection(port: int) -> socket.socket:
    """Begin to connect."""
    connection = socket.socket()
    connection.setblocking(False)
    with suppress(BlockingIOError):
        connection.connect(("127.0.0.1", port))
    return connection


def _is_closed(connection: socket.socket) -> bool:
    try:
        while connection.recv(65536):
            pass  # gRPC says hello
    except (BlockingIOError, InterruptedError):
        return False
    except OSError:
        return True
    return True
