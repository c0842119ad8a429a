"""Many clients of a service at once, in several processes: one alone would be the bottleneck."""

from __future__ import annotations

import asyncio
import multiprocessing
import time
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from clients import AsyncClient
from visloc.kapture import read_dataset

_CLIENTS_OF_PROCESS = 8
_START_S = 4.0  # that processes take to start


@dataclass(frozen=True, slots=True)
class Answered:
    """How long clients waited for their answers, and how many came.

    Attributes:
        latencies: (n,) seconds of each request.
        per_second: answers.
        stages: median seconds by stage, as the answers say.
    """

    latencies: list[float]
    per_second: float
    stages: Mapping[str, float]


def ask_at_once(url: str, map_id: str, query: Path, clients: int, seconds: float) -> Answered:
    """Let each client ask the dataset's photos one after the other, for so long."""
    counts = [_CLIENTS_OF_PROCESS] * (clients // _CLIENTS_OF_PROCESS)
    if clients % _CLIENTS_OF_PROCESS:
        counts.append(clients % _CLIENTS_OF_PROCESS)
    spawn = multiprocessing.get_context("spawn")
    begin = time.time() + _START_S
    with ProcessPoolExecutor(len(counts), mp_context=spawn) as pool:
        running = [pool.submit(_ask, url, map_id, query, n, begin, seconds) for n in counts]
        found = [answer for future in running for answer in future.result()]
    stages = {
        name: float(np.median([stage[name] for _, stage in found if name in stage]))
        for name in (found[0][1] if found else {})
    }
    return Answered([latency for latency, _ in found], len(found) / seconds, stages)


def _ask(
    url: str, map_id: str, query: Path, clients: int, begin: float, seconds: float
) -> list[tuple[float, Mapping[str, float]]]:
    """Return latencies and stages of the answers that came within the time."""
    return asyncio.run(_ask_all(url, map_id, query, clients, begin, seconds))


async def _ask_all(
    url: str, map_id: str, query: Path, clients: int, begin: float, seconds: float
) -> list[tuple[float, Mapping[str, float]]]:
    dataset = read_dataset(query)
    cameras = [dataset.sensors[record.sensor_id].camera for record in dataset.images]
    photos = [dataset.path_of(record).read_bytes() for record in dataset.images]
    found: list[tuple[float, Mapping[str, float]]] = []

    async def ask(client: AsyncClient, number: int) -> None:
        while time.time() < begin + seconds:
            one, number = number % len(photos), number + 1
            started = time.perf_counter()
            result = await client.localize(photos[one], map_id, cameras[one])
            latency = time.perf_counter() - started
            if time.time() <= begin + seconds:
                found.append((latency, result.seconds))

    async with AsyncClient(url) as client:
        begin = max(begin, time.time())
        await asyncio.sleep(begin - time.time())
        await asyncio.gather(*(ask(client, first) for first in range(clients)))
    return found
