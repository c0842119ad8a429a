"""Photos: the queue, callers that leave, and workers that die or hang."""

from __future__ import annotations

import asyncio
import logging
import os
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest

from service.engine.engine import Engine
from service.telemetry.logs import RequestRecord, begin_request
from service.telemetry.metrics import ServiceState
from service.workers import pool
from service.workers.tasks import Vision
from tests.service.engine.engines import (
    Query,
    WithEngine,
    held_back,
    job_for,
    make,
    publish,
    run,
    started,
    until,
)
from visloc.archive import MapStore
from visloc.errors import InvalidInput, NotFound, Overloaded, TimedOut, Unavailable


def test_an_answer_names_its_map_and_times_every_stage(
    with_engine: WithEngine, built_maps: Path, query: Query
) -> None:
    async def play(engine: Engine) -> None:
        found = await engine.localize(job_for(query))

        assert found.answer.pose is not None
        assert found.map_id == "room"
        assert found.map_version == MapStore(built_maps).current_version("room")
        seconds = found.answer.seconds
        assert list(seconds)[:4] == ["queued", "open_map", "decode", "local_features"]
        assert all(value >= 0 for value in seconds.values())

    with_engine(play)


@pytest.mark.parametrize(
    ("ref", "kind", "code"),
    [
        ("hall", NotFound, "map.unknown"),
        ("room@v9", NotFound, "map.version"),
        ("../room", InvalidInput, "map.id"),
        ("room@", InvalidInput, "map.id"),
        ("", InvalidInput, "map.id"),
    ],
)
def test_a_map_that_is_not_there_is_refused(
    ref: str, kind: type[Exception], code: str, built_maps: Path, query: Query
) -> None:
    async def play() -> None:
        engine = make(built_maps)
        engine._started = True  # nothing needs to be loaded for this
        for call in (engine.localize(job_for(query, ref)), engine.map(ref)):
            with pytest.raises(kind) as caught:
                await call
            assert getattr(caught.value, "code", None) == code
        await engine.close()

    run(play())


def test_one_photo_too_many_is_refused_at_once(with_engine: WithEngine, query: Query) -> None:
    async def play(engine: Engine) -> None:
        async with held_back(engine):
            accepted = [asyncio.create_task(engine.localize(job_for(query))) for _ in range(3)]
            await asyncio.sleep(0.1)
            with pytest.raises(Overloaded) as caught:
                await engine.localize(job_for(query))
            assert caught.value.code == "server.busy"

        answers = await asyncio.gather(*accepted)
        assert len(answers) == 3
        # The sleep began before the third was accepted: it waited most of it, not all.
        assert answers[2].answer.seconds["queued"] > 0.05
        await engine.localize(job_for(query))  # there is room again

    with_engine(play)


def test_a_photo_whose_caller_left_is_dropped_and_gives_back_its_place(
    with_engine: WithEngine, query: Query
) -> None:
    async def play(engine: Engine) -> None:
        async with held_back(engine):
            running = asyncio.create_task(engine.localize(job_for(query)))
            await until(lambda: engine.workers.running == 1)
            leaves, stays = (asyncio.create_task(engine.localize(job_for(query))) for _ in range(2))
            await until(lambda: engine.workers.waiting == 2)
            leaves.cancel()
            with pytest.raises(asyncio.CancelledError):
                await leaves
            assert engine.workers.waiting == 1
            after = asyncio.create_task(engine.localize(job_for(query)))
            await asyncio.sleep(0)
        await asyncio.gather(running, stays, after)

    with_engine(play)


def test_a_photo_that_is_worked_on_is_given_up_when_its_caller_leaves(
    with_engine: WithEngine, query: Query, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pool, "_STEP_LIMIT_S", 60.0)  # however busy the machine is

    async def play(engine: Engine) -> None:
        pids = engine.workers.pids
        async with held_back(engine):
            task = asyncio.create_task(engine.localize(job_for(query)))
            await until(lambda: engine.workers.running == 1)
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
        await until(lambda: engine.workers.running == 0)
        assert engine.workers.pids == pids
        await engine.localize(job_for(query))

    with_engine(play)


def test_the_worker_of_a_caller_who_left_is_replaced_if_it_goes_on_and_its_key_is_named(
    built_maps: Path,
    query: Query,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(pool, "_STEP_LIMIT_S", 0.1)

    async def ask(engine: Engine) -> None:
        begin_request(RequestRecord("http", "the-id", key="robot"))
        await engine.localize(job_for(query))

    async def play(engine: Engine) -> None:
        (pid,), loaded = engine.workers.pids, engine.workers.loaded
        async with held_back(engine):
            task = asyncio.create_task(ask(engine))
            await until(lambda: engine.workers.running == 1)
            other = asyncio.create_task(engine.localize(job_for(query)))
            task.cancel()
            assert (await other).answer.pose is not None
        assert pid not in engine.workers.pids
        await until(lambda: engine.workers.loaded == loaded)
        counted = engine._metrics.render(ServiceState())[0].decode()
        assert 'visloc_workers_ended_total{key="robot"} 1.0' in counted
        assert "visloc_worker_deaths_total 0.0" in counted
        assert not [each for each in caplog.records if each.levelno >= logging.ERROR]

    with started(built_maps) as with_engine:
        with_engine(play)


def test_a_new_process_opens_what_the_one_before_had_open_while_no_photo_waits(
    maps_dir: Path, query: Query
) -> None:
    publish(maps_dir, "1", "copy")

    async def play(engine: Engine) -> None:
        (pid,), loaded = engine.workers.pids, engine.workers.loaded
        assert len(loaded) == 2
        os.kill(pid, signal.SIGKILL)
        await until(lambda: pid not in engine.workers.pids and engine.workers.alive == 1)
        assert (await engine.localize(job_for(query))).answer.pose is not None
        await until(lambda: engine.workers.loaded == loaded)

    with started(maps_dir) as with_engine:
        with_engine(play)


def test_workers_work_at_the_same_time(with_two_workers: WithEngine, query: Query) -> None:
    async def play(engine: Engine) -> None:
        async with held_back(engine):
            tasks = [asyncio.create_task(engine.localize(job_for(query))) for _ in range(2)]
            await until(lambda: engine.workers.running == 2)
        await asyncio.gather(*tasks)

    with_two_workers(play)


def test_a_worker_that_dies_fails_its_own_request_and_is_replaced(
    with_two_workers: WithEngine, query: Query
) -> None:
    async def play(engine: Engine) -> None:
        one, other = engine.workers.pids
        alone = await engine.localize(job_for(query))
        async with held_back(engine):
            tasks = [asyncio.create_task(engine.localize(job_for(query))) for _ in range(4)]
            await until(lambda: engine.workers.running == 2)
            os.kill(one, signal.SIGKILL)
            await until(lambda: any(task.done() for task in tasks))
        found = await asyncio.gather(*tasks, return_exceptions=True)
        (died,) = [each for each in found if isinstance(each, Exception)]
        assert isinstance(died, Unavailable)
        assert died.code == "server.worker_died"
        for each in found:
            if not isinstance(each, BaseException):
                assert each.answer.pose is not None
                assert alone.answer.pose is not None
                assert np.array_equal(each.answer.pose.covariance, alone.answer.pose.covariance)
        await until(lambda: engine.workers.alive == 2)
        assert other in engine.workers.pids
        assert one not in engine.workers.pids
        assert engine.status.ready

    with_two_workers(play)


def test_a_swap_whose_worker_is_killed_goes_on_in_another(
    maps_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pool, "_WATCH_S", 60.0)  # so that only the swap runs
    version = MapStore(maps_dir).current_version("room")

    async def play(engine: Engine) -> None:
        (pid,) = engine.workers.pids
        async with held_back(engine):
            swapping = asyncio.create_task(engine.set_current("room", version))
            await until(lambda: engine.workers.running == 1)
            os.kill(pid, signal.SIGKILL)
            assert (await swapping).outline.manifest.version == version

    with started(maps_dir) as with_engine:
        with_engine(play)


def test_a_worker_that_died_idle_costs_no_request(
    built_maps: Path, query: Query, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pool, "_WATCH_S", 60.0)  # so that nobody notices before the photo comes

    async def play(engine: Engine) -> None:
        (pid,) = engine.workers.pids
        os.kill(pid, signal.SIGKILL)
        await until(lambda: not Path(f"/proc/{pid}").exists())
        assert (await engine.localize(job_for(query))).answer.pose is not None

    with started(built_maps) as with_engine:
        with_engine(play)


def test_a_photo_finds_the_successor_of_a_version_that_another_server_deleted(
    maps_dir: Path, query: Query
) -> None:
    before = MapStore(maps_dir).folder("room")

    async def play(engine: Engine) -> None:
        async with held_back(engine):
            lost = asyncio.create_task(engine.localize(job_for(query)))
            await until(lambda: engine.workers.running == 1)
            waiting = asyncio.create_task(engine.localize(job_for(query)))
            await until(lambda: engine.workers.waiting == 1)
            publish(maps_dir, "2")
            shutil.rmtree(before)
            os.kill(engine.workers.pids[0], signal.SIGKILL)
            with pytest.raises(Unavailable):
                await lost
        assert (await waiting).map_version == "2"

    with started(maps_dir) as with_engine:
        with_engine(play)


def test_an_idle_worker_that_dies_is_replaced(with_engine: WithEngine, query: Query) -> None:
    async def play(engine: Engine) -> None:
        (pid,) = engine.workers.pids
        os.kill(pid, signal.SIGKILL)
        await until(lambda: pid not in engine.workers.pids and engine.workers.alive == 1)
        await engine.localize(job_for(query))

    with_engine(play)


def test_a_worker_that_hangs_is_replaced_and_its_request_is_told(
    with_engine: WithEngine, query: Query
) -> None:
    async def play(engine: Engine) -> None:
        (pid,) = engine.workers.pids
        engine.workers._limit_s = 0.5
        os.kill(pid, signal.SIGSTOP)
        with pytest.raises(TimedOut) as caught:
            await engine.localize(job_for(query))
        assert caught.value.code == "server.deadline"
        engine.workers._limit_s = 60.0
        await engine.localize(job_for(query))
        assert pid not in engine.workers.pids

    with_engine(play)


def test_nothing_waits_for_workers_that_have_ended(tmp_path: Path) -> None:
    """An upload may be verified until then, and would wait for ever."""

    async def play() -> None:
        engine = make(tmp_path)
        await engine.start()
        await engine.close()
        async with asyncio.timeout(20):
            await engine.workers.run(Vision.ping)

    with pytest.raises(Unavailable) as caught:
        asyncio.run(play())
    assert caught.value.code == "server.stopping"
