"""Attacks on connections, one kind after the other, beside probes and one client."""

from __future__ import annotations

import asyncio
import os
import re
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from math import inf
from pathlib import Path

import grpc
import httpx
from grpc_health.v1 import health_pb2
from grpc_health.v1.health_pb2_grpc import HealthStub

from benchmarks.reliability.asking import Case, Doors, channel_to, good_cases
from benchmarks.reliability.attackers import ATTACKS, PAUSE_S, Assault, Attack, attacked
from benchmarks.reliability.checks import Check, counts_text
from benchmarks.reliability.load import Asked, ask_in_turn, percentile
from benchmarks.reliability.maps import SampleMaps
from benchmarks.reliability.replicas import balanced
from benchmarks.reliability.service_process import Addresses, ServiceProcess, free_port
from benchmarks.reliability.soak import Expected, unloaded_answers

FLOODING = 10  # connections of a flood
PROBE_LIMIT_S = 1.0
MOST_LOG_LINES = 50
MOST_P90 = 2.0
_PROBE_EVERY_S = 0.5
# gRPC itself refuses what comes in the moment in which all its places are taken.
_REFUSED_BY_GRPC = 1
_WARM_S = 3.0
ANOTHER_ADDRESS = "127.0.0.2"  # than that of honest clients


@dataclass(frozen=True)
class Strength:
    """How hard the attacks are.

    Attributes:
        count: connections of every attack that is no flood.
        seconds: of each attack.
        pause_s: before a connection that was closed is opened again.
        kinds: a word that the names of the attacks have; empty for all.
    """

    count: int
    seconds: float
    pause_s: float = PAUSE_S
    kinds: str = ""


@dataclass(frozen=True)
class Besieged:
    """A service, and what is asked of it meanwhile.

    Attributes:
        service: its process.
        front: the balancer before it.
        doors: to the front.
        cases: what honest clients ask.
        expected: what they are answered.
        metrics_port: the service's port for ``/metrics``.
    """

    service: ServiceProcess
    front: Addresses
    doors: Doors
    cases: Sequence[Case]
    expected: Expected
    metrics_port: int


@contextmanager
def _cores_apart() -> Iterator[Callable[[], None]]:
    """Keep the service on one core, and all that asks or attacks it on the others.

    Processes that are started in the block have the first core, until the function that is yielded
    is called. Otherwise the honest client would wait for the attackers' work too, not only for what
    the service makes of it. Does nothing on a single core.
    """
    cores = os.sched_getaffinity(0)
    first = {min(cores)}
    os.sched_setaffinity(0, first)
    try:
        yield lambda: os.sched_setaffinity(0, cores - first or cores)
    finally:
        os.sched_setaffinity(0, cores)


async def connections(maps: SampleMaps, work: Path, strength: Strength) -> list[Check]:
    """Attack a service through the balancer that comes with it in every way, from one address."""
    metrics_port = free_port()
    with (
        _cores_apart() as part,
        balanced([maps.folder], work, metrics_port=metrics_port) as found,
    ):
        part()
        [service] = found.replicas
        return await _attacked_in_turn(maps, service, found.front, metrics_port, strength)


async def _attacked_in_turn(
    maps: SampleMaps,
    service: ServiceProcess,
    front: Addresses,
    metrics_port: int,
    strength: Strength,
) -> list[Check]:
    cases = [case for case in good_cases(maps) if " photo " in case.name and "two" not in case.name]
    checks = []
    async with Doors(front) as doors:
        expected = await unloaded_answers(doors, maps, cases)
        besieged = Besieged(service, front, doors, cases, expected, metrics_port)
        await ask_in_turn(doors, cases, 1, _WARM_S)
        for attack in (each for each in ATTACKS if strength.kinds in each.name):
            checks.append(Check(*await _attack(besieged, attack, strength)))
    return checks


async def _attack(besieged: Besieged, attack: Attack, strength: Strength) -> tuple[str, str, bool]:
    """Ask alone, and then beside an attack."""
    service, doors, cases = besieged.service, besieged.doors, besieged.cases
    seconds = strength.seconds
    seed = hash(attack.name) % 1000
    alone = await ask_in_turn(doors, cases, 1, seconds, seed)
    lines = _lines(service.log)
    front = besieged.front
    port = front.http_port if attack.api == "HTTP" else front.grpc_port
    number = FLOODING if attack.is_flood else strength.count // attack.one_in
    assault = Assault(attack.name, port, number, strength.pause_s, ANOTHER_ADDRESS)
    worked_s = service.processor_seconds()
    async with attacked([assault]) as seen:
        await asyncio.sleep(1)
        probes = asyncio.create_task(probed(besieged, seconds))
        beside = await ask_in_turn(doors, cases, 1, seconds, seed)
        found = await probes
        worked_s = service.processor_seconds() - worked_s
        open_files = len(list(Path(f"/proc/{service.pid}/fd").iterdir()))
    lines = _lines(service.log) - lines
    late = {name: sum(each > PROBE_LIMIT_S for each in took) for name, took in found.items()}
    if attack.api == "gRPC":
        late["gRPC health"] = max(0, late["gRPC health"] - _REFUSED_BY_GRPC)
    slowest = max(each for took in found.values() for each in took)
    # A connection that was idle for a moment may be closed for another: clients ask again.
    lost = [one for one in beside if one.outcome.is_lost]
    wrong = [one for one in beside if one not in lost and _is_wrong(one, besieged.expected)]
    ratio = p90(beside) / p90(alone)
    return (
        f"{number} connections to {attack.api} that {attack.name}",
        f"probes later than {PROBE_LIMIT_S:g} s: {counts_text(Counter(late))}, slowest "
        f"{slowest:.2f} s; p90 {p90(beside) * 1e3:.0f} ms, alone {p90(alone) * 1e3:.0f} ms: "
        f"{ratio:.2f} times, {len(beside)} answers, {len(wrong)} wrong, {len(lost)} to ask again; "
        f"{lines} log lines; "
        f"{open_files} files; {worked_s:.1f} s of processor of the service; {counts_text(seen)}",
        not any(late.values()) and ratio <= MOST_P90 and lines <= MOST_LOG_LINES and not wrong,
    )


async def probed(besieged: Besieged, seconds: float) -> Mapping[str, list[float]]:
    """Ask for health and metrics over new connections; the seconds of each, infinity for failed."""
    front, metrics = besieged.front, f"http://127.0.0.1:{besieged.metrics_port}/metrics"
    asked: dict[str, Callable[[], Awaitable[None]]] = {
        "/healthz": lambda: _get(f"{front.url}/healthz"),
        "/readyz": lambda: _get(f"{front.url}/readyz"),
        "metrics": lambda: _get(metrics),
        "gRPC health": lambda: _check(front),
    }
    found = await asyncio.gather(*(_probed(probe, seconds) for probe in asked.values()))
    return dict(zip(asked, found, strict=True))


async def _probed(probe: Callable[[], Awaitable[None]], seconds: float) -> list[float]:
    found, end = [], time.monotonic() + seconds
    while (started := time.monotonic()) < end:
        took = inf
        with suppress(httpx.HTTPError, grpc.RpcError):
            await probe()
            took = time.monotonic() - started
        found.append(took)
        await asyncio.sleep(max(0.0, started + _PROBE_EVERY_S - time.monotonic()))
    return found


async def _get(url: str) -> None:
    async with httpx.AsyncClient(timeout=5) as http:
        (await http.get(url)).raise_for_status()


async def _check(front: Addresses) -> None:
    # A channel of its own, which would otherwise share the connection of the last one.
    async with channel_to(front, ("grpc.use_local_subchannel_pool", 1)) as channel:
        await HealthStub(channel).Check(health_pb2.HealthCheckRequest(), timeout=5)


def p90(asked: Sequence[Asked]) -> float:
    """The time within which nine of ten answers came; seconds."""
    return percentile([one.outcome.seconds for one in asked], 0.9)


def _is_wrong(asked: Asked, expected: Expected) -> bool:
    return (asked.outcome.status, asked.outcome.body) not in expected[asked.case.name]


def _lines(log: Path) -> int:
    """Count the lines, but for those of requests that were served."""
    served = re.compile(rb'"status": ?"(200|OK)"')
    return sum(served.search(line) is None for line in log.read_bytes().splitlines())
