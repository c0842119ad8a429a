"""Versions swapped, deleted and published without a pause, while workers of both replicas die."""

from __future__ import annotations

import asyncio
import os
import random
import signal
from collections import Counter
from collections.abc import Sequence
from contextlib import AsyncExitStack, ExitStack, suppress
from pathlib import Path
from typing import Any

import httpx

from benchmarks.reliability.asking import Doors, Outcome, good_cases
from benchmarks.reliability.checks import Check, counts_text
from benchmarks.reliability.kills import WORKER_DIED
from benchmarks.reliability.load import ask_in_turn
from benchmarks.reliability.maps import SampleMaps, leftovers, verify_store
from benchmarks.reliability.service_process import ServiceProcess
from benchmarks.reliability.uploads import ZIP

_CLIENTS = 2  # of each replica
# Between two kills of a worker of either replica; a replaced worker opens its maps within 0.6 s.
_KILL_EVERY_S = (0.8, 2.0)
# The line of a request is written after its answer.
_LOGGED_AFTER_S = 0.5


async def swaps(maps: SampleMaps, work: Path, seconds: float) -> list[Check]:
    """Swap versions on either of two replicas while the other deletes and publishes them."""
    cases = good_cases(maps)
    stop, changes, faults = asyncio.Event(), Counter[str](), list[str]()
    with ExitStack() as services:
        replicas = [
            services.enter_context(ServiceProcess(maps.folder, work / f"replica-{n}.log"))
            for n in range(2)
        ]
        async with AsyncExitStack() as opened:
            doors = [await opened.enter_async_context(Doors(each.addresses)) for each in replicas]
            asking = [
                asyncio.create_task(ask_in_turn(each, cases, _CLIENTS, seconds)) for each in doors
            ]
            changing = asyncio.create_task(_change(maps, doors, replicas, changes, faults, stop))
            killing = asyncio.create_task(_kill(replicas, stop))
            asked = [one.outcome for each in await asyncio.gather(*asking) for one in each]
            stop.set()
            await changing
            kills = await killing
    versions = await asyncio.to_thread(verify_store, maps.folder)
    return _checks(asked, changes, faults, kills, versions, leftovers(maps.folder))


async def _change(
    maps: SampleMaps,
    doors: Sequence[Doors],
    replicas: Sequence[ServiceProcess],
    changes: Counter[str],
    faults: list[str],
    stop: asyncio.Event,
) -> None:
    """Swap both maps, and delete and publish a version between; each replica in turn."""
    packed = maps.packed.read_bytes()
    first, last = maps.versions["room"]
    path, number = f"/maps/room/versions/{last}", 0

    async def done(replica: int, name: str, method: str, path: str, **body: Any) -> None:
        response = await doors[replica].http.request(method, path, **body)
        changes[f"{name} {response.status_code}"] += 1
        if response.status_code >= 500:
            faults.append(f"{name}: {await told(response, replicas[replica])}")

    async def use(replica: int, map_id: str, version: str) -> None:
        path, body = f"/maps/{map_id}/current", {"version": version}
        await done(replica, "swap", "POST", path, json=body)

    while not stop.is_set():
        number += 1
        one, other = number % 2, 1 - number % 2
        await use(one, "hall", maps.versions["hall"][one])
        await use(one, "room", first)
        # At once: the other replica still serves it.
        await done(one, "delete", "DELETE", path)
        await done(other, "publish", "PUT", path, content=packed, headers=ZIP)
        await use(other, "room", last)


async def _kill(replicas: Sequence[ServiceProcess], stop: asyncio.Event) -> int:
    kills, draw = 0, random.Random(0)
    while True:
        with suppress(TimeoutError):
            await asyncio.wait_for(stop.wait(), draw.uniform(*_KILL_EVERY_S))
            return kills
        pids = replicas[kills % 2].worker_pids
        if pids:
            with suppress(ProcessLookupError):
                os.kill(pids[0], signal.SIGKILL)
                kills += 1


async def told(response: httpx.Response, replica: ServiceProcess) -> str:
    """Return an answer's body, and what the log of its replica says about it."""
    await asyncio.sleep(_LOGGED_AFTER_S)
    id_ = response.headers.get("x-request-id", "without an id")
    lines = [line for line in replica.log.read_text(errors="replace").splitlines() if id_ in line]
    return f"{response.status_code} {response.text.strip()}; log: {' '.join(lines) or 'nothing'}"


def _checks(
    asked: Sequence[Outcome],
    changes: Counter[str],
    faults: Sequence[str],
    kills: int,
    versions: int,
    left: Sequence[str],
) -> list[Check]:
    statuses = Counter(one.status for one in asked)
    return [
        Check(
            "no swap, publication or deletion is answered 5xx",
            "; ".join([f"{counts_text(changes)}; {kills} workers killed", *faults]),
            not faults and kills > 0,
        ),
        Check(
            "a killed worker costs at most the request that it worked on",
            counts_text(statuses),
            set(statuses) <= {"200", "OK", *WORKER_DIED}
            and sum(statuses[died] for died in WORKER_DIED) <= kills,
        ),
        Check(
            "no publication is lost or torn",
            f"{versions} versions read byte by byte; {len(left)} files left over",
            not left,
        ),
    ]
