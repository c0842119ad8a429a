"""Everything at once: attacks, swaps, killed workers and a replaced replica, and honest clients."""

from __future__ import annotations

import asyncio
import os
import random
import signal
import threading
from collections import Counter
from collections.abc import Sequence
from contextlib import AsyncExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic
from typing import Any

import httpx

from benchmarks.reliability.asking import Case, Doors, good_cases
from benchmarks.reliability.attackers import ATTACKS, Assault, attacked
from benchmarks.reliability.checks import Check, counts_text
from benchmarks.reliability.connections import ANOTHER_ADDRESS
from benchmarks.reliability.heavy_requests import heavy_photo_requests, many_value_messages
from benchmarks.reliability.load import (
    RETRY_PAUSE_S,
    Persisted,
    ask_in_turn,
    percentile,
    stopped_within,
)
from benchmarks.reliability.maps import SampleMaps, leftovers, verify_store
from benchmarks.reliability.replicas import Balanced, balanced
from benchmarks.reliability.service_process import Addresses, ServiceProcess
from benchmarks.reliability.soak import Expected, differing, unloaded_answers

SHARE = 0.7  # of the capacity
EVERY_S = 20.0  # swaps, kills, publications
MAX_GROWTH = 0.10
_CAPACITY_S = 10.0
_HOLDING, _FLOODING = 80, 2  # connections of each attack
_HEAVY_PAUSE_S = 2.0
_WARM_SHARE = 1 / 3
# The line of a request is written after its answer.
_LOGGED_AFTER_S = 0.5
_MIB = 2**20
# What a client asks again after: nothing was worked on, or the other replica may answer.
_AGAIN = (
    *("429", "503", "UNAVAILABLE", "RESOURCE_EXHAUSTED", "no answer"),
    *("500 server.worker_died", "INTERNAL server.worker_died"),
)


@dataclass
class Happened:
    """What was done to the replicas, and what they said to it."""

    swaps: Counter[str] = field(default_factory=Counter)
    published: Counter[str] = field(default_factory=Counter)
    attacks: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)
    kills: int = 0
    replaced: int = 0
    memory: list[tuple[float, int]] = field(default_factory=list)


async def siege(maps: SampleMaps, work: Path, seconds: float) -> list[Check]:
    """Ask two replicas behind the balancer at 70 % of their capacity while all attacks run.

    The attacks come from one address, honest clients from another.
    """
    cases = good_cases(maps)
    happened = Happened()
    with balanced([maps.folder, maps.folder], work) as found:
        async with Doors(found.front) as doors:
            expected = await unloaded_answers(doors, maps, cases)
            alone = await ask_in_turn(doors, cases, 2, _CAPACITY_S)
            capacity = len(alone) / _CAPACITY_S
            stop = asyncio.Event()
            harm = asyncio.create_task(_harm(maps, found, doors, happened, stop, seconds))
            honest = await _ask(doors, cases, SHARE * capacity, seconds)
            stop.set()
            await harm
    quiet = [one.outcome.seconds for one in alone]
    versions = await asyncio.to_thread(verify_store, maps.folder)
    return _checks(honest, expected, capacity, quiet, happened, versions, leftovers(maps.folder))


async def _ask(doors: Doors, cases: Sequence[Case], rate: float, seconds: float) -> list[Persisted]:
    draw, started = random.Random(0), monotonic()
    asking: list[asyncio.Task[Persisted]] = []
    while (now := monotonic() - started) < seconds:
        due = len(asking) / rate
        if now < due:
            await asyncio.sleep(due - now)
        asking.append(asyncio.create_task(_persist(doors, draw.choice(cases))))
    return list(await asyncio.gather(*asking))


async def _persist(doors: Doors, case: Case) -> Persisted:
    started, tries = monotonic(), list[str]()
    while True:
        outcome = await case.ask(doors)
        seconds = monotonic() - started
        # As long as the clients of the service do by default, and a little longer.
        if not outcome.status.startswith(_AGAIN) or seconds > 60:
            return Persisted(case, outcome, tuple(tries), seconds)
        tries.append(outcome.status)
        await asyncio.sleep(min(RETRY_PAUSE_S * len(tries), 4.0))


async def _harm(
    maps: SampleMaps,
    found: Balanced,
    doors: Doors,
    happened: Happened,
    stop: asyncio.Event,
    seconds: float,
) -> None:
    """Do everything at once until told to stop."""
    replicas, front, heavy = found.replicas, found.front, threading.Event()
    threads = [
        asyncio.create_task(asyncio.to_thread(_send_heavy, maps, front, heavy, happened, number))
        for number in range(len(replicas))
    ]
    async with AsyncExitStack() as attacks:
        await attacks.enter_async_context(
            attacked(
                [
                    Assault(
                        attack.name,
                        front.http_port if attack.api == "HTTP" else front.grpc_port,
                        _FLOODING if attack.is_flood else _HOLDING,
                        source=ANOTHER_ADDRESS,
                    )
                    for attack in ATTACKS
                ]
            )
        )
        await asyncio.gather(
            _change(maps, replicas, doors, happened, stop),
            _kill_workers(replicas, happened, stop),
            _replace(replicas[1], happened, stop, seconds / 2),
            _sample(replicas[0], happened, stop),
        )
    heavy.set()
    await asyncio.gather(*threads)


def _send_heavy(
    maps: SampleMaps,
    front: Addresses,
    stop: threading.Event,
    happened: Happened,
    number: int,
) -> None:
    """Send photos and messages that cost much, one after the other."""
    messages = [*heavy_photo_requests(maps), *many_value_messages().values()]
    while not stop.wait(_HEAVY_PAUSE_S):
        with suppress(OSError, httpx.HTTPError):
            happened.attacks[messages[number % len(messages)](front)] += 1
        number += 1


async def _change(
    maps: SampleMaps,
    replicas: Sequence[ServiceProcess],
    doors: Doors,
    happened: Happened,
    stop: asyncio.Event,
) -> None:
    """Swap the versions of all maps every 20 s, and publish one again; each until it is done."""
    packed, number = maps.packed.read_bytes(), 0
    first, last = maps.versions["room"]
    headers = {"Content-Type": "application/zip"}

    async def change(method: str, path: str, **body: Any) -> str:
        response = await _until_done(doors, method, path, **body)
        if response.status_code >= 500:
            happened.faults.append(f"{method} {path}: {await _told(response, *replicas)}")
        return str(response.status_code)

    async def use(map_id: str, version: str) -> None:
        path, body = f"/maps/{map_id}/current", {"version": version}
        happened.swaps[await change("POST", path, json=body)] += 1

    while not await stopped_within(stop, EVERY_S):
        number += 1
        await use("hall", maps.versions["hall"][number % 2])
        await use("room", first)
        path = f"/maps/room/versions/{last}"
        await change("DELETE", path)
        added = await change("PUT", path, content=packed, headers=headers)
        happened.published[added] += 1
        await use("room", last)


async def _told(response: httpx.Response, *replicas: ServiceProcess) -> str:
    """Return an answer's body, and what the logs of the replicas say about it."""
    await asyncio.sleep(_LOGGED_AFTER_S)
    id_ = response.headers.get("x-request-id", "without an id")
    logs = [replica.log.read_text(errors="replace") for replica in replicas]
    lines = [line for log in logs for line in log.splitlines() if id_ in line]
    return f"{response.status_code} {response.text.strip()}; log: {' '.join(lines) or 'nothing'}"


async def _until_done(doors: Doors, method: str, path: str, **body: Any) -> httpx.Response:
    """Ask until there is room; return the answer."""
    while True:
        with suppress(httpx.TransportError):
            response = await doors.http.request(method, path, **body)
            if response.status_code not in (429, 503):
                return response
        await asyncio.sleep(RETRY_PAUSE_S)


async def _kill_workers(
    replicas: Sequence[ServiceProcess], happened: Happened, stop: asyncio.Event
) -> None:
    while not await stopped_within(stop, EVERY_S):
        pids = replicas[happened.kills % len(replicas)].worker_pids
        if pids:
            with suppress(ProcessLookupError):
                os.kill(pids[0], signal.SIGKILL)
                happened.kills += 1


async def _replace(
    replica: ServiceProcess, happened: Happened, stop: asyncio.Event, after_s: float
) -> None:
    if not await stopped_within(stop, after_s):
        await asyncio.to_thread(replica.stop)
        replica.start()
        await asyncio.to_thread(replica.wait_until_ready)
        happened.replaced += 1


async def _sample(replica: ServiceProcess, happened: Happened, stop: asyncio.Event) -> None:
    started = monotonic()
    while not await stopped_within(stop, 2.0):
        happened.memory.append((monotonic() - started, replica.resident_bytes()[0]))


def _checks(
    honest: Sequence[Persisted],
    expected: Expected,
    capacity: float,
    quiet: Sequence[float],
    happened: Happened,
    versions: int,
    left: Sequence[str],
) -> list[Check]:
    unanswered = [one for one in honest if one.outcome.status.startswith(_AGAIN)]
    answered = [one for one in honest if not one.outcome.status.startswith(_AGAIN)]
    wrong = differing(answered, expected)
    tries = Counter(status for one in honest for status in one.errors)
    took = [one.seconds for one in answered]
    warm = [size for at, size in happened.memory if at >= happened.memory[-1][0] * _WARM_SHARE]
    # The least of each half: what stays when no large request is under way.
    before, after = min(warm[: len(warm) // 2]), min(warm[len(warm) // 2 :])
    return [
        Check(
            "every honest request is answered in the end",
            f"{len(answered)} of {len(honest)}, at {SHARE:.0%} of {capacity:.1f}/s; "
            f"{sum(bool(one.errors) for one in honest)} asked again ({counts_text(tries)}); p50 "
            f"{percentile(took, 0.5):.2f} s, p90 {percentile(took, 0.9):.2f} s, longest "
            f"{max(took, default=0):.1f} s; alone p90 {percentile(quiet, 0.9):.2f} s",
            not unanswered,
        ),
        Check(
            "answers are those of the quiet run, bit for bit",
            f"{len(answered) - len(wrong)} of {len(answered)}"
            + "".join(f"; {one.case.name}: {one.outcome.status}" for one in wrong[:3]),
            not wrong,
        ),
        Check(
            f"memory of the replica that stays grows by at most {MAX_GROWTH:.0%} after a third",
            f"{before / _MIB:.0f} MiB, then {after / _MIB:.0f} MiB",
            after <= (1 + MAX_GROWTH) * before,
        ),
        Check(
            "no publication is lost or torn",
            f"published {counts_text(happened.published)}, swapped {counts_text(happened.swaps)}; "
            f"{versions} versions read byte by byte; {len(left)} files left over"
            + "".join(f"; {fault}" for fault in happened.faults),
            set(happened.published) <= {"201", "409"} and set(happened.swaps) == {"200"},
        ),
        Check(
            "all of it happened",
            f"{happened.kills} workers killed, {happened.replaced} replica replaced; heavy "
            f"requests: {counts_text(happened.attacks)}",
            happened.kills > 0 and happened.replaced == 1,
        ),
    ]
