from __future__ import annotations

import asyncio
import os
import re
import signal
import time
from collections.abc import Callable
from operator import methodcaller
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from service.values import Abandoned, MapFolder, WorkerSettings
from service.workers import pool
from service.workers.pool import Turn, _Worker, share_of_cores
from service.workers.vision import Vision
from visloc.errors import Unavailable


@pytest.mark.parametrize(
    ("cores", "running", "most", "threads"),
    [
        (2, 1, 2, 2),  # a photo alone
        (2, 2, 2, 1),
        (16, 1, 16, 16),
        (16, 3, 16, 5),
        (16, 16, 16, 1),
        (16, 2, 4, 4),  # no more than were asked for
        (2, 3, 2, 1),  # more workers than cores
    ],
)
def test_photos_that_are_localized_at_the_same_time_share_the_cores(
    cores: int, running: int, most: int, threads: int
) -> None:
    assert share_of_cores(cores, running, most) == threads


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(pool, "monotonic", made)
    return made


def test_a_request_falls_back_by_what_was_spent_on_it_but_not_behind_new_ones(
    clock: Clock,
) -> None:
    earlier = Turn(clock())
    first = earlier.rank()
    clock.now += 1
    later = Turn(clock())
    assert first < later.rank()
    clock.now += 2  # both wait; then 0.2 s of work
    earlier.worked(0.2)
    later.worked(0.0)
    assert later.rank() < earlier.rank() <= Turn(clock()).rank()


def test_silence_between_the_instants_of_a_stream_earns_no_right_to_overtake(clock: Clock) -> None:
    silent = [Turn(clock()) for _ in range(8)]
    for each in silent[:4]:
        each.rank()
        clock.now += 0.5
        each.worked(0.1)
    clock.now += 3600
    photo = Turn(clock()).rank()
    clock.now += 0.01
    for each in silent:
        assert each.rank() > photo


SETTINGS = WorkerSettings(
    weights_dir=None,
    threads=1,
    max_loaded_bytes=2**30,
    max_images=16,
    max_instants=1000,
    max_image_bytes=2**20,
    max_image_pixels=10**6,
)


def much(_: object) -> bytes:
    """A task whose result takes a while to send."""
    return bytes(2**28)


def test_a_worker_that_is_killed_in_the_middle_of_its_answer_is_known_to_be_dead() -> None:
    async def play() -> None:
        worker = _Worker(SETTINGS)
        await worker.start()
        asked = asyncio.create_task(worker.run(300.0, much, 1))
        assert worker._connection is not None
        while not worker._connection.poll(0):  # it begins to answer
            await asyncio.sleep(0)
        os.kill(worker.pid, signal.SIGKILL)
        async with asyncio.timeout(20):
            with pytest.raises(Unavailable) as caught:
                await asked
        assert caught.value.code == "server.worker_died"
        await worker.stop()

    asyncio.run(play())


LONG_S = 60.0


def waits(_: Vision) -> None:
    """A task within native code that lets other threads run."""
    time.sleep(LONG_S)


def computes(_: Vision) -> None:
    """A task within native code that lets no other thread run."""
    re.fullmatch("(a+)+", "a" * 40 + "b")


def stopped(_: Vision) -> None:
    """A task that takes no signals, as if the system had no time for it."""
    os.kill(os.getpid(), signal.SIGSTOP)


def opens(vision: Vision) -> None:
    """A task that opens a map, which takes longer than a task may go on."""

    def slow(_: object) -> Any:
        time.sleep(0.5)
        return SimpleNamespace(size_bytes=1)  # like what a set opens

    vision._maps._open = slow  # type: ignore[method-assign]
    vision.load(MapFolder("hall@1", Path("hall")))
    time.sleep(LONG_S)


def steps(vision: Vision) -> None:
    """A task that ends at its next step."""
    while True:
        vision._step()
        time.sleep(0.01)


@pytest.mark.parametrize(
    ("task", "limit_s", "is_ended"),
    [
        (waits, 0.1, True),
        (computes, 0.1, True),
        (stopped, 0.1, True),
        (opens, 0.1, False),  # else a map that takes long would never be open
        (steps, LONG_S, False),
    ],
)
def test_a_process_is_ended_if_it_goes_on_with_a_task_that_nobody_waits_for(
    monkeypatch: pytest.MonkeyPatch, task: Callable[[Vision], None], limit_s: float, is_ended: bool
) -> None:
    monkeypatch.setattr(pool, "_STEP_LIMIT_S", limit_s)

    async def play() -> None:
        worker = _Worker(SETTINGS)
        await worker.start()
        pid = worker.pid
        asked = asyncio.create_task(worker.run(300.0, task, 1))
        async with asyncio.timeout(20):
            while not worker.busy or worker._signals.opening != (task is opens):
                await asyncio.sleep(0)
            worker.abandon()
            await asyncio.wait({asked})
        assert (worker.overdue, worker.alive) == (is_ended, not is_ended)
        assert isinstance(asked.exception(), Unavailable if is_ended else Abandoned)
        if is_ended:
            await worker.start()
        assert (await worker.run(300.0, methodcaller("ping"), 1) == pid) != is_ended
        assert not worker.overdue
        assert [opened.ref for opened in worker.open_maps] == ["hall@1"] * (task is opens)
        await worker.stop()

    asyncio.run(play())
