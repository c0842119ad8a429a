"""kill -9 under load: of workers, and of the whole service, which the test starts again."""

from __future__ import annotations

import asyncio
import os
import random
import signal
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import httpx

from benchmarks.reliability.asking import Case, Doors, good_cases
from benchmarks.reliability.checks import Check, counts_text
from benchmarks.reliability.load import RETRY_PAUSE_S, Persisted, persist
from benchmarks.reliability.maps import (
    SampleMaps,
    leftovers,
    tree_hash,
    verify_store,
)
from benchmarks.reliability.service_process import ServiceProcess, is_alive
from benchmarks.reliability.soak import Expected, differing, unloaded_answers

WORKER_DIED = frozenset({"500 server.worker_died", "INTERNAL server.worker_died"})
AWAY = frozenset({"503 server.starting", "UNAVAILABLE server.starting"})
CLIENTS = 4
BACK_WITHIN_S = 10.0
_POLL_S = 0.05


@dataclass(frozen=True)
class _Return:
    """How a killed service came back.

    Attributes:
        ready_s: from the new start to a good /readyz.
        answer_s: from the new start to the first pose.
        orphans: workers of the killed process that still lived then.
        versions: that were read byte by byte while the service was away.
        leftovers: files of broken uploads that were still there when it was back.
    """

    ready_s: float
    answer_s: float
    orphans: int
    versions: int
    leftovers: int


async def kill_workers(maps: SampleMaps, work: Path, kills: int) -> list[Check]:
    """Kill workers one after another while clients ask."""
    cases = good_cases(maps)
    with ServiceProcess(maps.folder, work / "service.log", workers=2) as service:
        async with Doors(service.addresses) as doors:
            expected = await unloaded_answers(doors, maps, cases)
            stop = asyncio.Event()
            asking = asyncio.create_task(persist(doors, cases, CLIENTS, stop, WORKER_DIED))
            replaced = [await _kill_a_worker(service, number) for number in range(kills)]
            stop.set()
            done = await asking
    errors = Counter(error for one in done for error in one.errors)
    return [
        Check(
            "a worker that is killed costs at most the request that it worked on, and that is told",
            f"{kills} killed, {counts_text(errors)}",
            set(errors) <= WORKER_DIED and errors.total() <= kills,
        ),
        _retry_check(done, expected),
        Check(
            "another takes its place within 10 s",
            f"at most {max(replaced):.1f} s",
            max(replaced) < BACK_WITHIN_S,
            is_speed=True,
        ),
    ]


async def kill_service(maps: SampleMaps, work: Path, kills: int) -> list[Check]:
    """Kill the whole service while clients ask and versions are uploaded, swapped and deleted."""
    cases = good_cases(maps)
    service = ServiceProcess(maps.folder, work / "service.log", workers=1)
    with service:
        async with Doors(service.addresses) as doors:
            expected = await unloaded_answers(doors, maps, cases)
            # The version that comes and goes; the others must survive.
            coming = maps.folder / "room" / maps.versions["room"][-1]
            kept = [f for f in maps.folder.glob("*/*") if f.is_dir() and f != coming]
            before = [tree_hash(folder) for folder in kept]
            stop = asyncio.Event()
            asking = asyncio.create_task(persist(doors, cases, CLIENTS, stop, AWAY))
            changing = asyncio.create_task(_change(service, maps, stop))
            draw = random.Random(0)
            returns = []
            for _ in range(kills):
                await asyncio.sleep(draw.uniform(2, 4))
                returns.append(await _kill_service(service, maps, cases[0], doors))
            stop.set()
            done, changes = await asking, await changing
    after = [tree_hash(folder) for folder in kept]
    ready, answer = max(r.ready_s for r in returns), max(r.answer_s for r in returns)
    errors = Counter(error for one in done for error in one.errors)
    return [
        Check(
            "started again, it is ready and gives a pose within 10 s",
            f"{kills} kills: ready after {ready:.1f} s, a pose after {answer:.1f} s at most",
            answer < BACK_WITHIN_S,
            is_speed=True,
        ),
        Check(
            "clients see connections that break, then the service that starts",
            counts_text(errors),
            all(error in AWAY or error.startswith("no answer") for error in errors),
        ),
        _retry_check(done, expected),
        Check(
            "nothing published is lost or torn",
            f"{sum(r.versions for r in returns)} versions read byte by byte after the kills, "
            f"{sum(a == b for a, b in zip(before, after, strict=True))} of {len(kept)} that "
            "nobody changed are as before",
            before == after,
        ),
        Check(
            "uploads, swaps and deletions that broke can be repeated",
            f"{changes.total()} answers: {counts_text(changes)}",
            not any(status[0] == "5" for status in changes),
        ),
        Check(
            "nothing of the killed process stays: no worker, no half of an upload",
            f"{sum(r.orphans for r in returns)} workers, {sum(r.leftovers for r in returns)} files",
            not any(r.orphans or r.leftovers for r in returns),
        ),
    ]


async def _kill_a_worker(service: ServiceProcess, number: int) -> float:
    """Kill the next worker; the seconds until another takes requests."""
    await asyncio.sleep(2)
    before = sorted(service.worker_pids)
    os.kill(before[number % len(before)], signal.SIGKILL)
    started = time.monotonic()
    while service.log.read_text().count("took over") <= number:
        await asyncio.sleep(_POLL_S)
    return time.monotonic() - started


async def _kill_service(
    service: ServiceProcess, maps: SampleMaps, case: Case, doors: Doors
) -> _Return:
    workers = service.worker_pids
    service.kill()
    # The workers may still be writing their last words.
    versions = await asyncio.to_thread(verify_store, maps.folder)
    started = time.monotonic()
    service.start()
    await asyncio.to_thread(service.wait_until_ready)
    ready_s = time.monotonic() - started
    while (await case.ask(doors)).status != "200":
        await asyncio.sleep(_POLL_S)
    answer_s = time.monotonic() - started
    orphans = sum(is_alive(pid) for pid in workers)
    # Before the next upload of the changing client can begin, or with it under way: only files
    # that are older than the new process are of the old one.
    left = [
        name
        for name in leftovers(maps.folder)
        if (maps.folder / name).stat().st_mtime < time.time() - answer_s
    ]
    return _Return(ready_s, answer_s, orphans, versions, len(left))


async def _change(service: ServiceProcess, maps: SampleMaps, stop: asyncio.Event) -> Counter[str]:
    """Delete, upload and swap the versions of ``room`` in turn; each until it is done."""
    first, last = maps.versions["room"]
    packed = maps.packed.read_bytes()
    statuses: Counter[str] = Counter()
    async with httpx.AsyncClient(base_url=service.url, timeout=60) as http:

        async def until_done(method: str, path: str, done: Sequence[int], **body: object) -> None:
            while True:
                with suppress(httpx.TransportError):
                    response = await http.request(method, path, **body)  # type: ignore[arg-type]
                    if response.status_code != 503:
                        statuses[f"{response.status_code} {method}"] += 1
                        assert response.status_code in done, response.text
                        return
                await asyncio.sleep(RETRY_PAUSE_S)

        version = f"/maps/room/versions/{last}"
        headers = {"Content-Type": "application/zip"}
        while not stop.is_set():
            await until_done("POST", "/maps/room/current", [200], json={"version": first})
            # A change whose answer was lost may have been made: that is told, and no harm.
            await until_done("DELETE", version, [204, 404])
            await until_done("PUT", version, [201, 409], content=packed, headers=headers)
            await until_done("POST", "/maps/room/current", [200], json={"version": last})
    return statuses


def _retry_check(done: Sequence[Persisted], expected: Expected) -> Check:
    wrong = differing(done, expected)
    again = [one for one in done if one.errors]
    longest = max((one.seconds for one in again), default=0.0)
    return Check(
        "clients retry safely: every request gets the answer of the unloaded service in the end",
        f"{len(done) - len(wrong)} of {len(done)} equal, {len(again)} of them after errors, "
        f"those within {longest:.1f} s"
        + "".join(f"; {one.case.name}: {one.outcome.status}" for one in wrong[:3]),
        not wrong,
    )
