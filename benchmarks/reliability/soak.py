"""Twice the work that the service can do, good and bad, while versions of its maps are swapped."""

from __future__ import annotations

import asyncio
import json
import time
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from benchmarks.reliability.asking import Case, Doors, bad_cases, good_cases
from benchmarks.reliability.checks import Check, counts_text
from benchmarks.reliability.load import (
    Answered,
    Asked,
    ask_at_rate,
    ask_in_turn,
    percentile,
    stopped_within,
)
from benchmarks.reliability.maps import SampleMaps
from benchmarks.reliability.service_process import ServiceProcess

SWAP_EVERY_S = 20.0
SAMPLE_EVERY_S = 2.0
CAPACITY_S = 15.0
# Memory is looked at after this share of the time, when caches are full.
WARM_SHARE = 1 / 3
MAX_GROWTH = 0.05
MAX_QUEUE = 8
_MIB = 2**20

# By name of a case: its unloaded answers, one for each version of the maps, as status and body.
Expected = Mapping[str, set[tuple[str, str]]]


async def soak(maps: SampleMaps, work: Path, seconds: float) -> list[Check]:
    """Load a service, and compare every answer with what it said when it had nothing else to do."""
    good, bad = good_cases(maps), bad_cases(maps)
    with ServiceProcess(
        maps.folder, work / "service.log", workers=1, max_queue=MAX_QUEUE, max_batches=2
    ) as service:
        async with Doors(service.addresses) as doors:
            expected = await unloaded_answers(doors, maps, [*good, *bad])
            mix = [*good, *good, *bad]
            capacity = await _capacity(doors, mix)
            stop = asyncio.Event()
            swapping = asyncio.create_task(_swap(doors, maps, stop))
            sampling = asyncio.create_task(_sample(service, stop))
            asked = await ask_at_rate(doors, mix, 2 * capacity, seconds)
            stop.set()
            swaps, memory = await swapping, await sampling
            restarts = _worker_deaths((await doors.http.get("/metrics")).text)
    return [
        *_answer_checks(asked, expected, capacity, seconds),
        _once_check(asked, work / "service.log"),
        Check(
            "versions are swapped every 20 s, no swap fails",
            f"{swaps.total()} swaps: {counts_text(swaps)}",
            set(swaps) == {"200"},
        ),
        *(_memory_check(memory, column) for column in (0, 1)),
        Check("no worker dies", f"{restarts:g} died", restarts == 0),
    ]


async def unloaded_answers(doors: Doors, maps: SampleMaps, cases: Sequence[Case]) -> Expected:
    """Ask everything once for each version of the maps, one by one."""
    expected: dict[str, set[tuple[str, str]]] = defaultdict(set)
    for hall in maps.versions["hall"]:
        for room in maps.versions["room"]:
            for map_id, version in {"hall": hall, "room": room}.items():
                used = await doors.http.post(f"/maps/{map_id}/current", json={"version": version})
                used.raise_for_status()
            for case in cases:
                outcome = await case.ask(doors)
                expected[case.name].add((outcome.status, outcome.body))
    return expected


def differing(asked: Sequence[Answered], expected: Expected) -> list[Answered]:
    """Return those whose answers are not among the unloaded ones."""
    return [
        one
        for one in asked
        if (one.outcome.status, one.outcome.body) not in expected[one.case.name]
    ]


def _answer_checks(
    asked: Sequence[Asked], expected: Expected, capacity: float, seconds: float
) -> list[Check]:
    busy = [one for one in asked if one.outcome.is_busy]
    accepted = [one for one in asked if not one.outcome.is_busy]
    different = differing(accepted, expected)
    known = {status for answers in expected.values() for status, _ in answers}
    unexpected = Counter(
        one.outcome.status
        for one in accepted
        if one.outcome.status[0] == "5" or one.outcome.status not in known
    )
    good = Counter(one.outcome.status for one in accepted)
    took = [one.outcome.seconds for one in accepted if one.outcome.status in ("200", "OK")]
    refused = [one.outcome.seconds for one in busy]
    return [
        Check(
            "load is at least twice the capacity",
            f"{len(asked) / seconds:.1f} requests/s for {seconds:g} s, capacity {capacity:.1f}/s",
            len(asked) / seconds > 1.9 * capacity,
        ),
        Check(
            "what is too much is refused at once",
            f"{len(busy)} of {len(asked)} refused, half of them within "
            f"{percentile(refused, 0.5) * 1e3:.0f} ms; answers p50 {percentile(took, 0.5):.2f} s, "
            f"p90 {percentile(took, 0.9):.2f} s",
            bool(busy),
        ),
        Check(
            "accepted answers are those of the unloaded service, bit for bit",
            f"{len(accepted) - len(different)} of {len(accepted)} equal"
            + "".join(f"; {one.case.name}: {one.outcome.status}" for one in different[:3]),
            not different,
        ),
        Check(
            "no unexpected 5xx",
            f"{counts_text(unexpected)} (answers: {counts_text(good)})",
            not unexpected,
        ),
    ]


def _once_check(asked: Sequence[Asked], log: Path) -> Check:
    logged: Counter[str] = Counter()
    for line in log.read_text().splitlines():
        entry = json.loads(line)
        if entry["logger"] == "service.access":
            logged[entry["request_id"]] += 1
    lost = sum(one.outcome.is_lost for one in asked)
    others = sum(not one.outcome.own for one in asked)
    # A message that gRPC's library refuses, or a call that never reached a method, has no id.
    repeated = sum(logged[one.id] > 1 for one in asked)
    unlogged = sum(logged[one.id] == 0 for one in asked)
    return Check(
        "every request is answered exactly once, with its own id",
        f"{len(asked)} sent, {lost} without an answer, {others} with another's id, "
        f"{repeated} served more than once, {unlogged} not in the log",
        lost == others == repeated == unlogged == 0,
    )


def _memory_check(memory: Sequence[tuple[float, int, int]], column: int) -> Check:
    samples = np.array(memory, dtype=np.float64)
    samples = samples[samples[:, 0] >= samples[-1, 0] * WARM_SHARE]
    minutes, mib = samples[:, 0] / 60, samples[:, 1 + column] / _MIB
    slope = float(np.polyfit(minutes, mib, 1)[0]) if len(minutes) > 1 else float("nan")
    growth = slope * float(minutes[-1] - minutes[0]) / float(mib.mean())
    what = ("the main process", "all processes together")[column]
    return Check(
        f"memory of {what} is flat: grows by less than 5 % in the last two thirds",
        f"{mib.mean():.0f} MiB (from {mib.min():.0f} to {mib.max():.0f}), "
        f"slope {slope:+.2f} MiB/min, {growth:+.1%}",
        growth < MAX_GROWTH,
    )


async def _capacity(doors: Doors, cases: Sequence[Case]) -> float:
    """Requests per second that are answered when there is always one more, and none is refused."""
    asked = await ask_in_turn(doors, cases, 2, CAPACITY_S)
    return len(asked) / CAPACITY_S


async def _swap(doors: Doors, maps: SampleMaps, stop: asyncio.Event) -> Counter[str]:
    statuses: Counter[str] = Counter()
    count = 0
    while not await stopped_within(stop, SWAP_EVERY_S):
        count += 1
        for number, (map_id, versions) in enumerate(maps.versions.items()):
            # So that every pair of versions comes up.
            version = versions[(count >> number) % len(versions)]
            response = await doors.http.post(f"/maps/{map_id}/current", json={"version": version})
            statuses[str(response.status_code)] += 1
    return statuses


async def _sample(service: ServiceProcess, stop: asyncio.Event) -> list[tuple[float, int, int]]:
    started = time.monotonic()
    samples = []
    while not await stopped_within(stop, SAMPLE_EVERY_S):
        samples.append((time.monotonic() - started, *service.resident_bytes()))
    return samples


def _worker_deaths(metrics: str) -> float:
    return sum(
        float(line.rpartition(" ")[2])
        for line in metrics.splitlines()
        if line.startswith("visloc_worker_deaths_total")
    )
