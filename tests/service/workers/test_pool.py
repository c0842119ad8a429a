from __future__ import annotations

import asyncio
import os
import signal

import pytest

from service.values import WorkerSettings
from service.workers import pool
from service.workers.pool import Turn, _Worker, share_of_cores
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


def much(_: object) -> bytes:
    """A task whose result takes a while to send."""
    return bytes(2**28)


def test_a_worker_that_is_killed_in_the_middle_of_its_answer_is_known_to_be_dead() -> None:
    settings = WorkerSettings(
        weights_dir=None,
        threads=1,
        max_loaded_bytes=2**30,
        max_images=16,
        max_instants=1000,
        max_image_bytes=2**20,
        max_image_pixels=10**6,
    )

    async def play() -> None:
        worker = _Worker(settings)
        await worker.start(())
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
