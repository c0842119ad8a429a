"""Load: requests at a given rate, or by clients that each wait for their answer."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from time import perf_counter

from benchmarks.reliability.asking import Case, Doors, Outcome

# Between two attempts of a client that got an error.
RETRY_PAUSE_S = 0.5


@dataclass(frozen=True)
class Answered:
    """A request and what came of it."""

    case: Case
    outcome: Outcome


@dataclass(frozen=True)
class Asked(Answered):
    """A request that was sent once.

    Attributes:
        id: of the request.
    """

    id: str


@dataclass(frozen=True)
class Persisted(Answered):
    """A request that was sent until it was answered.

    Attributes:
        errors: what came before the answer.
        seconds: from the first attempt to the answer.
    """

    errors: tuple[str, ...]
    seconds: float


async def ask_at_rate(
    doors: Doors, cases: Sequence[Case], rate: float, seconds: float, seed: int = 0
) -> list[Asked]:
    """Send requests at a rate, whatever becomes of those before, and wait for all answers."""
    draw = random.Random(seed)
    started = perf_counter()
    asking: list[asyncio.Task[Asked]] = []
    while (now := perf_counter() - started) < seconds:
        due = len(asking) / rate
        if now < due:
            await asyncio.sleep(due - now)
        asking.append(asyncio.create_task(_ask(doors, draw.choice(cases), f"load-{len(asking)}")))
    return list(await asyncio.gather(*asking))


async def ask_in_turn(
    doors: Doors, cases: Sequence[Case], clients: int, seconds: float, seed: int = 0
) -> list[Asked]:
    """Let clients send their next request when the one before is answered."""
    draw = random.Random(seed)
    end = perf_counter() + seconds

    async def client(number: int) -> list[Asked]:
        asked: list[Asked] = []
        while perf_counter() < end:
            asked.append(await _ask(doors, draw.choice(cases), f"turn-{number}-{len(asked)}"))
        return asked

    answered = await asyncio.gather(*(client(number) for number in range(clients)))
    return [asked for of_client in answered for asked in of_client]


async def persist(
    doors: Doors, cases: Sequence[Case], clients: int, stop: asyncio.Event, retried: frozenset[str]
) -> list[Persisted]:
    """Let clients ask in turn until told to stop, each request until it is answered.

    Args:
        doors: of the service.
        cases: drawn from at random.
        clients: at once.
        stop: no new request after it.
        retried: statuses after which a request is sent again; connections that break always are.
    """
    draw = random.Random(0)

    async def client() -> list[Persisted]:
        done: list[Persisted] = []
        while not stop.is_set():
            case, errors, started = draw.choice(cases), [], perf_counter()
            while (outcome := await case.ask(doors)).is_lost or outcome.status in retried:
                errors.append(outcome.status)
                await asyncio.sleep(RETRY_PAUSE_S)
            done.append(Persisted(case, outcome, tuple(errors), perf_counter() - started))
        return done

    answered = await asyncio.gather(*(client() for _ in range(clients)))
    return [one for of_client in answered for one in of_client]


async def _ask(doors: Doors, case: Case, id_: str) -> Asked:
    return Asked(case, await case.ask(doors, id_), id_)


async def stopped_within(stop: asyncio.Event, seconds: float) -> bool:
    """Wait for an event for so long; whether it is set."""
    with suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            await stop.wait()
    return stop.is_set()


def percentile(values: Sequence[float], share: float) -> float:
    """The value below which this share of them lies; nan without any."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else float("nan")
