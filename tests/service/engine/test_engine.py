from __future__ import annotations

import asyncio
import json
import logging
import os
import shutil
import signal
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, TypeVar

import cv2
import numpy as np
import pytest

from service.engine import catalog
from service.engine.engine import Engine
from service.telemetry.metrics import Metrics
from service.values import (
    ImageJob,
    InstantJob,
    Localization,
    RigJob,
    SequenceJob,
    WorkerSettings,
    photo_job,
)
from visloc.archive import MapStore
from visloc.errors import (
    Conflict,
    InvalidInput,
    MapCorrupt,
    NotFound,
    Overloaded,
    TimedOut,
    TooLarge,
    Unavailable,
)
from visloc.evaluation import pose_error
from visloc.geometry import Camera, Pose
from visloc.images import ImageLimits
from visloc.kapture import read_dataset
from visloc.options import LocalizeOptions
from visloc.priors import NO_PRIORS, GravityPrior, PositionPrior, Priors
from visloc.sequences.filling import Odometry, TimeUnit
from visloc.types import PoseSource, Reason, RigSensor

T = TypeVar("T")


class Query(Protocol):
    image: bytes
    camera: Camera


LIMITS = ImageLimits()


def make(
    maps_dir: Path, *, limits: ImageLimits = LIMITS, max_instants: int = 1000, **settings: Any
) -> Engine:
    of_workers = WorkerSettings(
        weights_dir=None,
        threads=1,
        max_loaded_bytes=settings.pop("max_loaded_bytes", 2**30),
        max_images=16,
        max_instants=max_instants,
        max_image_bytes=limits.max_bytes,
        max_image_pixels=limits.max_pixels,
    )
    return Engine(MapStore(maps_dir), of_workers, metrics=Metrics(), **settings)


async def until(happened: Callable[[], bool], seconds: float = 20.0) -> None:
    async with asyncio.timeout(seconds):
        while not happened():
            await asyncio.sleep(0.02)


@contextmanager
def held_back(engine: Engine) -> Iterator[None]:
    """Stop the worker processes for a while, as a busy machine does."""
    pids = engine.workers.pids
    try:
        for pid in pids:
            os.kill(pid, signal.SIGSTOP)
        yield
    finally:
        for pid in pids:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)


def run(coroutine: Coroutine[Any, Any, T]) -> T:
    return asyncio.run(coroutine)


Play = Callable[[Engine], Coroutine[Any, Any, None]]
WithEngine = Callable[[Play], None]


@contextmanager
def started(maps_dir: Path, **settings: Any) -> Iterator[WithEngine]:
    """Start an engine, and give what plays with it."""
    with asyncio.Runner() as runner:
        engine = make(maps_dir, **settings)
        runner.run(engine.start())
        try:
            yield lambda play: runner.run(play(engine))
        finally:
            runner.run(engine.close())


@pytest.fixture(scope="module")
def with_engine(built_maps: Path) -> Iterator[WithEngine]:
    """An engine with the map ``room`` and narrow limits, for all tests that leave it as it was."""
    limits = ImageLimits(max_bytes=200_000)
    settings = {"max_queue": 2, "max_batches": 1, "max_instants": 20}
    with started(built_maps, limits=limits, **settings) as with_engine:
        yield with_engine


@pytest.fixture(scope="module")
def with_two_workers(built_maps: Path) -> Iterator[WithEngine]:
    """An engine with the map ``room`` and two worker processes."""
    with started(built_maps, workers=2) as with_engine:
        yield with_engine


def job_for(query: Query, ref: str = "room") -> RigJob:
    return photo_job((ref,), query.image, query.camera, LocalizeOptions())


def publish(maps_dir: Path, version: str, map_id: str = "room") -> None:
    """Make a copy of the current version and switch to it."""
    source = MapStore(maps_dir).folder("room")
    target = maps_dir / map_id / version
    shutil.copytree(source, target)
    manifest = json.loads((target / "manifest.json").read_text())
    manifest |= {"id": map_id, "version": version}
    (target / "manifest.json").write_text(json.dumps(manifest))
    (maps_dir / map_id / "current").write_text(version)


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


def test_photos_are_refused_until_the_maps_are_warm(maps_dir: Path, query: Query) -> None:
    async def play() -> None:
        engine = make(maps_dir)
        with pytest.raises(Unavailable) as caught:
            await engine.localize(job_for(query))
        assert caught.value.code == "server.starting"
        assert not engine.status.ready

        await engine.start()
        assert engine.status.ready
        assert engine.status.maps == (f"room@{MapStore(maps_dir).current_version('room')}",)
        await engine.close()
        assert not engine.status.ready

    run(play())


def test_a_published_version_and_a_new_map_are_served_without_a_restart(
    maps_dir: Path, query: Query
) -> None:
    async def play() -> None:
        engine = make(maps_dir)
        await engine.start()
        old = (await engine.localize(job_for(query))).map_version
        publish(maps_dir, "v2")
        publish(maps_dir, "v1", map_id="hall")

        # Nobody waits for the new version: the old one answers until it is warm.
        await engine.localize(job_for(query))
        await until(lambda: "room@v2" in engine.status.maps)
        assert (await engine.localize(job_for(query))).map_version == "v2"
        assert (await engine.localize(job_for(query, "hall"))).map_id == "hall"
        assert (await engine.map("room")).outline.manifest.version == "v2"
        assert [m.outline.manifest.id for m in await engine.maps()] == ["hall", "room"]
        await until(lambda: engine.status.maps == ("hall@v1", "room@v2"))
        # The older version is still there for those who name it.
        assert (await engine.localize(job_for(query, f"room@{old}"))).map_version == old
        await engine.close()

    run(play())


def test_a_broken_new_version_leaves_the_one_before_in_service(
    maps_dir: Path, query: Query, caplog: pytest.LogCaptureFixture
) -> None:
    async def play() -> None:
        engine = make(maps_dir)
        await engine.start()
        old = (await engine.localize(job_for(query))).map_version
        publish(maps_dir, "v2")
        (maps_dir / "room" / "v2" / "landmarks.npy").unlink()

        await until(lambda: "room" in engine.status.not_loaded)
        for _ in range(3):
            assert (await engine.localize(job_for(query))).map_version == old
        assert (await engine.map("room")).outline.manifest.version == old
        assert [m.outline.manifest.version for m in await engine.maps()] == [old]
        with pytest.raises(MapCorrupt):
            await engine.localize(job_for(query, "room@v2"))

        (maps_dir / "room" / "current").write_text(old)
        publish(maps_dir, "v3")
        await until(lambda: "room@v3" in engine.status.maps)
        assert (await engine.localize(job_for(query))).map_version == "v3"
        await engine.close()

    with caplog.at_level(logging.ERROR):
        run(play())
    (record,) = caplog.records
    assert "room@v2 cannot be opened" in record.message
    assert "landmarks.npy" in record.message


def test_a_broken_map_does_not_keep_the_others_from_being_served(
    maps_dir: Path, query: Query, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def play() -> None:
        publish(maps_dir, "v1", map_id="hall")
        manifest = maps_dir / "hall" / "v1" / "manifest.json"
        good = manifest.read_bytes()
        manifest.write_text("{}")
        engine = make(maps_dir)
        await engine.start()

        assert engine.status.ready
        assert list(engine.status.not_loaded) == ["hall"]
        assert isinstance(engine.status.not_loaded["hall"], MapCorrupt)
        assert [m.outline.manifest.id for m in await engine.maps()] == ["room"]
        await engine.localize(job_for(query))
        with pytest.raises(MapCorrupt):
            await engine.localize(job_for(query, "hall"))

        manifest.write_bytes(good)
        monkeypatch.setattr(catalog, "RETRY_AFTER_S", 0.0)
        await engine.localize(job_for(query, "hall"))
        assert engine.status.not_loaded == {}
        await engine.close()

    run(play())
    assert "map hall is not loaded" in caplog.text


def without_an_array(folder: Path) -> None:
    model = next((folder / "global").glob("*.model.npz"))
    with np.load(model) as arrays:
        kept = {name: arrays[name] for name in arrays.files[1:]}
    np.savez(model, **kept)
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["files"][f"global/{model.name}"]["size"] = model.stat().st_size
    (folder / "manifest.json").write_text(json.dumps(manifest))


def with_a_folder_as_manifest(folder: Path) -> None:
    (folder / "manifest.json").unlink()
    (folder / "manifest.json").mkdir()


@pytest.mark.parametrize(
    ("damage", "code"),
    [(without_an_array, "map.unusable"), (with_a_folder_as_manifest, "map.manifest")],
)
def test_whatever_a_damaged_map_breaks_the_others_are_served(
    damage: Callable[[Path], None],
    code: str,
    maps_dir: Path,
    query: Query,
    caplog: pytest.LogCaptureFixture,
) -> None:
    async def play() -> None:
        publish(maps_dir, "v1", map_id="hall")
        damage(maps_dir / "hall" / "v1")
        engine = make(maps_dir)
        await engine.start()

        assert engine.status.ready
        assert engine.status.not_loaded.keys() == {"hall"}
        assert engine.status.not_loaded["hall"].code == code
        assert "room" in [m.outline.manifest.id for m in await engine.maps()]
        assert (await engine.localize(job_for(query))).map_id == "room"
        with pytest.raises(MapCorrupt):
            await engine.localize(job_for(query, "hall"))

        before = (await engine.localize(job_for(query))).map_version
        publish(maps_dir, "v2")
        damage(maps_dir / "room" / "v2")
        await until(lambda: "room" in engine.status.not_loaded)
        assert (await engine.localize(job_for(query))).map_version == before
        assert engine.status.not_loaded["room"].code == code
        await engine.close()

    run(play())
    assert "map room@v2 cannot be opened" in caplog.text


def test_a_refused_version_is_named_left_alone_for_a_while_and_tried_again(
    maps_dir: Path, query: Query, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def play() -> None:
        engine = make(maps_dir)
        await engine.start()
        old = (await engine.localize(job_for(query))).map_version
        publish(maps_dir, "v2")
        landmarks = maps_dir / "room" / "v2" / "landmarks.npy"
        landmarks.rename(landmarks.with_name("away"))

        await until(lambda: "room" in engine.status.not_loaded)
        assert (await engine.localize(job_for(query))).map_version == old
        assert engine.status.maps == (f"room@{old}",)
        assert "v2" in str(engine.status.not_loaded["room"])

        landmarks.with_name("away").rename(landmarks)
        assert (await engine.localize(job_for(query))).map_version == old
        monkeypatch.setattr(catalog, "RETRY_AFTER_S", 0.0)
        await until(lambda: "room@v2" in engine.status.maps)
        assert (await engine.localize(job_for(query))).map_version == "v2"
        assert engine.status.not_loaded == {}
        await engine.close()

    run(play())


def test_a_damaged_name_of_the_current_version_leaves_the_one_before_in_service(
    maps_dir: Path, query: Query
) -> None:
    async def play() -> None:
        engine = make(maps_dir)
        await engine.start()
        old = (await engine.localize(job_for(query))).map_version
        (maps_dir / "room" / "current").write_bytes(b"\xff")

        assert (await engine.localize(job_for(query))).map_version == old
        assert engine.status.not_loaded["room"].code == "map.current"
        await engine.close()

    run(play())


def test_deleted_maps_disappear(maps_dir: Path, query: Query) -> None:
    async def play() -> None:
        for map_id in ("hall", "yard"):
            publish(maps_dir, "v1", map_id=map_id)
        (maps_dir / "yard" / "v1" / "landmarks.npy").unlink()
        engine = make(maps_dir)
        await engine.start()
        assert len(engine.status.maps) == 2
        assert engine.status.not_loaded.keys() == {"yard"}

        for map_id in ("hall", "yard"):
            shutil.rmtree(maps_dir / map_id)
        await until(lambda: not engine.status.not_loaded)
        await until(lambda: [ref.partition("@")[0] for ref in engine.status.maps] == ["room"])
        with pytest.raises(NotFound):
            await engine.localize(job_for(query, "hall"))
        await engine.close()

    run(play())


def test_a_map_is_described_without_opening_it_twice(maps_dir: Path) -> None:
    async def play() -> None:
        engine = make(maps_dir)
        by_id = await engine.map("room")
        assert (await engine.map(by_id.outline.ref)).outline is by_id.outline
        assert by_id.current
        await engine.close()

    run(play())


def test_a_map_whose_features_are_not_here_is_a_conflict_not_the_callers_mistake(
    maps_dir: Path, query: Query
) -> None:
    manifest = MapStore(maps_dir).folder("room") / "manifest.json"
    manifest.write_text(manifest.read_text().replace('"sift"', '"surf"'))

    async def play() -> None:
        engine = make(maps_dir)
        await engine.start()
        with pytest.raises(Conflict) as caught:
            await engine.localize(job_for(query))
        assert caught.value.code == "features.unknown"
        await engine.close()

    run(play())


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
        with held_back(engine):
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
        with held_back(engine):
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
    with_engine: WithEngine, query: Query
) -> None:
    async def play(engine: Engine) -> None:
        with held_back(engine):
            task = asyncio.create_task(engine.localize(job_for(query)))
            await until(lambda: engine.workers.running == 1)
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
        await until(lambda: engine.workers.running == 0)
        assert engine.workers.alive == 1
        await engine.localize(job_for(query))

    with_engine(play)


def test_workers_work_at_the_same_time(with_two_workers: WithEngine, query: Query) -> None:
    async def play(engine: Engine) -> None:
        with held_back(engine):
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
        with held_back(engine):
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


def test_maps_are_closed_by_least_recent_use(maps_dir: Path, query: Query) -> None:
    for map_id in ("hall", "yard"):
        publish(maps_dir, "v1", map_id=map_id)

    async def play(engine: Engine) -> None:
        room = await engine.map("room")
        assert engine.status.ready
        for map_id in ("hall", "room", "yard", "room"):
            assert (await engine.localize(job_for(query, map_id))).map_id == map_id
            assert sum(engine.workers.loaded.values()) <= 2.5 * room.outline.size_bytes
        assert {ref.partition("@")[0] for ref in engine.status.maps} == {"room", "yard"}

    size = sum(path.stat().st_size for path in MapStore(maps_dir).folder("room").rglob("*.np*"))
    with started(maps_dir, max_loaded_bytes=int(2.5 * size)) as with_engine:
        with_engine(play)


def test_no_maps_at_all_is_a_state_to_be_ready_in(tmp_path: Path) -> None:
    async def play() -> None:
        engine = make(tmp_path / "absent")
        await engine.start()
        assert engine.status.ready
        assert await engine.maps() == []
        await engine.close()

    run(play())


# Several maps, rigs and sequences

FAST = LocalizeOptions(top_k=4)


@dataclass(frozen=True)
class RigPhotos:
    """One instant of the sample's rig."""

    photos: dict[str, bytes]
    sensors: dict[str, RigSensor]
    rig_from_world: Pose


@pytest.fixture(scope="module")
def rig_photos(sample: Path) -> RigPhotos:
    dataset = read_dataset(sample / "query")
    first = dataset.images[0].timestamp
    records = {r.sensor_id: r for r in dataset.images if r.timestamp == first}
    sensors = {
        name: RigSensor(dataset.rigs["rig"][name], dataset.sensors[name].camera) for name in records
    }
    pose = dataset.pose(records["left"])
    assert pose is not None
    return RigPhotos(
        {name: dataset.path_of(record).read_bytes() for name, record in records.items()},
        sensors,
        sensors["left"].cam_from_rig.inverse() @ pose,
    )


def blank() -> bytes:
    return cv2.imencode(".png", np.full((192, 256), 128, np.uint8))[1].tobytes()


def scramble(maps_dir: Path, map_id: str) -> None:
    """Mix up the landmarks of a map: nothing is localized in it."""
    path = MapStore(maps_dir).folder(map_id) / "landmarks.npy"
    np.save(path, np.random.default_rng(0).permutation(np.load(path)))


def rig_job(rig_photos: RigPhotos, **changes: Any) -> RigJob:
    images = tuple(ImageJob(name, photo, None) for name, photo in rig_photos.photos.items())
    job = RigJob(("room",), rig_photos.sensors, images, 5, FAST)
    return replace(job, **changes)


@pytest.fixture(scope="module")
def with_two_maps(
    built_maps: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[WithEngine]:
    """An engine with ``room``, and ``hall``, whose landmarks are mixed up."""
    maps_dir = tmp_path_factory.mktemp("two") / "maps"
    shutil.copytree(built_maps, maps_dir)
    publish(maps_dir, "v1", map_id="hall")
    scramble(maps_dir, "hall")
    with started(maps_dir) as with_engine:
        yield with_engine


@pytest.fixture(scope="module")
def with_a_map_without_down(
    built_maps: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[WithEngine]:
    """An engine with a map that does not know which way is down."""
    maps_dir = tmp_path_factory.mktemp("no_down") / "maps"
    shutil.copytree(built_maps, maps_dir)
    manifest = MapStore(maps_dir).folder("room") / "manifest.json"
    record = json.loads(manifest.read_text())
    record["world"].pop("gravity", None)
    record["world"].pop("anchor", None)
    manifest.write_text(json.dumps(record))
    with started(maps_dir) as with_engine:
        yield with_engine


def test_of_several_maps_the_one_with_the_best_answer_is_named(
    with_two_maps: WithEngine, query: Query, rig_photos: RigPhotos
) -> None:
    async def play(engine: Engine) -> None:
        alone = await engine.localize(replace(job_for(query), options=FAST))
        for maps in (("hall", "room"), ("room", "hall")):
            found = await engine.localize(replace(job_for(query), maps=maps, options=FAST))
            assert found.map_id == "room"
            assert found.answer.pose is not None
            assert alone.answer.pose is not None
            assert np.array_equal(found.answer.pose.covariance, alone.answer.pose.covariance)

        both = await engine.localize_rig(rig_job(rig_photos, maps=("hall", "room")))
        assert (both.map_id, both.answer.timestamp) == ("room", 5)
        assert both.answer.pose is not None

        lost = await engine.localize(replace(job_for(query), maps=("hall",), options=FAST))
        assert lost.map_id == "hall"
        assert lost.answer.pose is None

    with_two_maps(play)


def test_the_rig_of_the_sample_is_localized_within_a_few_millimetres(
    with_two_workers: WithEngine, rig_photos: RigPhotos
) -> None:
    # 256 x 192 pixels and 8 mapping photos: measured 1.1 mm and 0.037 degrees.
    async def play(engine: Engine) -> None:
        inline = await engine.localize_rig(rig_job(rig_photos))
        named = await engine.localize_rig(rig_job(rig_photos, rig="rig"))
        for found in (inline, named):
            pose = found.answer.pose
            assert pose is not None
            position_m, orientation_deg = pose_error(pose.rig_from_world, rig_photos.rig_from_world)
            assert position_m < 0.003
            assert orientation_deg < 0.05
            assert pose.source is PoseSource.ESTIMATED
            used = [image.evidence.camera for image in found.answer.images if image.evidence]
            assert used == [sensor.camera for sensor in rig_photos.sensors.values()]

    with_two_workers(play)


def test_an_image_that_cannot_be_read_fails_alone(
    with_engine: WithEngine, rig_photos: RigPhotos
) -> None:
    left, right = (ImageJob(name, photo, None) for name, photo in rig_photos.photos.items())

    async def play(engine: Engine) -> None:
        other_size = Camera("SIMPLE_PINHOLE", 640, 300, (500.0, 320.0, 150.0))
        for broken, code in (
            (replace(right, query=b""), "image.empty"),
            (replace(right, query=b"no photo"), "image.format"),
            (replace(right, query=b"\xff\xd8\xff" + bytes(10**6)), "image.too_large"),
            (replace(right, camera=other_size), "camera.size_mismatch"),
        ):
            found = await engine.localize_rig(rig_job(rig_photos, images=(left, broken)))
            assert found.answer.pose is not None
            errors = [image.error for image in found.answer.images]
            assert errors[0] is None
            assert errors[1] is not None
            assert errors[1].code == code
        assert errors[1] is not None
        found = await engine.localize_rig(
            rig_job(rig_photos, images=(replace(left, query=b""), replace(right, query=b"x")))
        )
        assert found.answer.refusal is not None
        assert found.answer.refusal.reason is Reason.NO_USABLE_IMAGE

    with_engine(play)


@pytest.mark.parametrize(
    ("change", "kind", "code", "field"),
    [
        (lambda _: {"images": ()}, InvalidInput, "rig.empty", "images"),
        (lambda _: {"rig": "car"}, NotFound, "rig.unknown", "rig"),
        (lambda _: {"rig": {}}, InvalidInput, "rig.sensor", "images[0].sensor"),
        (lambda r: {"rig": {"left": r.sensors["left"]}}, InvalidInput, "rig.sensor", None),
        (
            lambda r: {"images": (ImageJob("left", r.photos["left"], None),) * 2},
            *(InvalidInput, "rig.duplicate", "images"),
        ),
        (
            lambda _: {"images": tuple(ImageJob(str(i), b"", None) for i in range(17))},
            *(TooLarge, "rig.too_many_images", "images"),
        ),
        (lambda _: {"maps": ("room", "cellar")}, NotFound, "map.unknown", None),
        (
            lambda _: {"priors": Priors(gravity=GravityPrior(np.array([0.0, 1.0, 0.0]), 0.02))},
            *(InvalidInput, "priors.gravity", "priors.gravity"),
        ),
    ],
)
def test_a_rig_that_does_not_fit_is_refused_before_any_photo_is_read(
    change: Callable[[RigPhotos], dict[str, Any]],
    kind: type[Exception],
    code: str,
    field: str | None,
    with_a_map_without_down: WithEngine,
    rig_photos: RigPhotos,
) -> None:
    async def play(engine: Engine) -> None:
        with pytest.raises(kind) as caught:
            await engine.localize_rig(rig_job(rig_photos, **change(rig_photos)))
        error: Any = caught.value
        assert error.code == code
        assert field is None or error.field == field
        assert error.expected or error.message

    with_a_map_without_down(play)


def instants_of(
    photos: Sequence[bytes], camera: Camera, *, start: int = 1_700_000_000_000
) -> list[InstantJob]:
    return [
        InstantJob(start + 100 * i, (ImageJob("camera", photo, camera),), None, None)
        for i, photo in enumerate(photos)
    ]


START = SequenceJob(("room",), None, None, 1.0, FAST)


async def answers_of(
    engine: Engine, start: SequenceJob, instants: Sequence[InstantJob]
) -> list[Localization]:
    """Sent one by one, as a stream is."""

    async def sent() -> AsyncIterator[InstantJob]:
        for instant in instants:
            yield instant

    return [answer async for answer in engine.localize_sequence(start, sent())]


def test_a_sequence_in_several_maps_keeps_the_first_that_localizes_and_all_its_answers(
    with_two_maps: WithEngine, query: Query
) -> None:
    instants = instants_of([blank(), b"broken", query.image, blank()], query.camera)
    start = replace(START, maps=("hall", "room"))

    async def play(engine: Engine) -> None:
        found = await answers_of(engine, start, instants)
        assert [each.map_id for each in found] == ["room"] * 4
        assert [each.answer.timestamp for each in found] == [i.timestamp for i in instants]
        sources = [each.answer.pose and each.answer.pose.source for each in found]
        nearest = PoseSource.NEAREST
        assert sources == [nearest, nearest, PoseSource.ESTIMATED, nearest]
        # Those that are all there are checked first, and answered the same.
        at_once = [each async for each in engine.localize_sequence(start, instants)]
        assert [each.answer.num_inliers for each in at_once] == [
            each.answer.num_inliers for each in found
        ]
        # Where none is localized, the first map answers for all.
        lost = await answers_of(engine, start, instants[:2])
        assert [each.map_id for each in lost] == ["hall", "hall"]
        assert [each.answer.pose for each in lost] == [None, None]

    with_two_maps(play)


def test_a_sequence_is_answered_as_it_comes(with_engine: WithEngine, query: Query) -> None:
    first, second, third = instants_of([query.image, blank(), query.image], query.camera)
    taken: list[int] = []

    async def sent() -> AsyncIterator[InstantJob]:
        for instant in (first, second, third):
            taken.append(instant.timestamp)
            yield instant

    async def play(engine: Engine) -> None:
        answers = engine.localize_sequence(START, sent())
        assert (await anext(answers)).answer.timestamp == first.timestamp
        # The next is not taken before this one has been.
        assert taken == [first.timestamp]
        assert (await anext(answers)).answer.timestamp == second.timestamp
        assert len(taken) == 3
        assert [a.answer.timestamp async for a in answers] == [third.timestamp]

    with_engine(play)


def odometry() -> Odometry:
    return Odometry(Pose.identity(), None)


@pytest.mark.parametrize(
    ("change", "start", "kind", "code", "field"),
    [
        (lambda _: [], {}, InvalidInput, "sequence.empty", "instants"),
        (
            lambda i: [i[0], replace(i[1], timestamp=i[0].timestamp)],
            *({}, InvalidInput, "sequence.timestamps", "instants[1].timestamp"),
        ),
        (
            lambda i: [i[1], i[0]],
            *({}, InvalidInput, "sequence.timestamps", "instants[1].timestamp"),
        ),
        (
            lambda i: [replace(i[0], timestamp=0)],
            *({}, InvalidInput, "sequence.time_unit", "time_unit"),
        ),
        (
            lambda i: [replace(i[0], timestamp=-5)],
            *({}, InvalidInput, "sequence.time_unit", None),
        ),
        (
            lambda i: [replace(i[0], timestamp=t) for t in range(10_000)],
            *({"time_unit": TimeUnit.S}, TooLarge, "sequence.too_many_instants", "instants"),
        ),
        (
            lambda i: [replace(i[0], images=i[0].images * 2)],
            *({}, InvalidInput, "sequence.rig", "instants[0].images"),
        ),
        (
            lambda i: [i[0], replace(i[1], images=i[0].images)],
            *({"rig": "car"}, NotFound, "rig.unknown", "rig"),
        ),
        (
            lambda i: i,
            *({"rig": "rig"}, InvalidInput, "rig.sensor", "instants[0].images[0].sensor"),
        ),
        (lambda i: i, {"max_gap_s": 61.0}, InvalidInput, "sequence.max_gap", "max_gap_s"),
        (lambda i: i, {"maps": ("room", "attic")}, NotFound, "map.unknown", None),
    ],
)
def test_a_sequence_that_cannot_be_is_refused_by_name(
    change: Callable[[list[InstantJob]], list[InstantJob]],
    start: dict[str, Any],
    kind: type[Exception],
    code: str,
    field: str | None,
    with_engine: WithEngine,
    query: Query,
) -> None:
    instants = change(instants_of([b"x", b"y"], query.camera))

    async def play(engine: Engine) -> None:
        # One by one, and all at once: then nothing is answered before.
        changed = replace(START, **start)
        for asked in (
            answers_of(engine, changed, instants),
            anext(engine.localize_sequence(changed, instants)),
        ):
            with pytest.raises(kind) as caught:
                await asked
            error: Any = caught.value
            assert error.code == code
            assert field is None or error.field == field

    with_engine(play)


def test_priors_of_an_instant_replace_those_of_the_sequence(
    with_engine: WithEngine, query: Query
) -> None:
    lie = Priors(PositionPrior(np.array([900.0, 0.0, 0.0]), 1.0))
    one, two = instants_of([query.image, query.image], query.camera)

    async def play(engine: Engine) -> None:
        start = replace(START, priors=lie, max_gap_s=0.0)
        found = await answers_of(engine, start, [one, replace(two, priors=NO_PRIORS)])
        refusals = [each.answer.refusal for each in found]
        assert refusals[0] is not None
        assert refusals[0].reason is Reason.NO_PHOTO_NEAR
        assert refusals[1] is None

    with_engine(play)


def test_instants_without_images_live_on_odometry(with_engine: WithEngine, query: Query) -> None:
    seen, *unseen = instants_of([query.image, b"", b""], query.camera)
    instants = [replace(seen, odometry=odometry())]
    instants += [replace(instant, images=(), odometry=odometry()) for instant in unseen]

    async def play(engine: Engine) -> None:
        found = await answers_of(engine, START, instants)
        poses = [each.answer.pose for each in found]
        assert [pose and pose.source for pose in poses] == [
            PoseSource.ESTIMATED,
            PoseSource.MOTION,
            PoseSource.MOTION,
        ]

    with_engine(play)


def test_batches_have_places_of_their_own(built_maps: Path) -> None:
    engine = make(built_maps, max_batches=2)
    with pytest.raises(Unavailable) as early, engine.admit_batch():
        pass
    assert early.value.code == "server.starting"
    engine._started = True
    with engine.admit_batch():
        with engine.admit_batch(), pytest.raises(Overloaded) as caught, engine.admit_batch():
            pass
        assert caught.value.code == "server.busy"
        # A place is given back whatever happened in it.
        with pytest.raises(ZeroDivisionError), engine.admit_batch():
            raise ZeroDivisionError
        with engine.admit_batch():
            pass
    with engine.admit_batch(), engine.admit_batch():
        pass


def test_a_sequence_that_is_given_up_frees_everything(
    with_engine: WithEngine, query: Query
) -> None:
    async def play(engine: Engine) -> None:
        instants = instants_of([query.image] * 20, query.camera)

        async def ask() -> None:
            with engine.admit_batch():
                await answers_of(engine, START, instants)

        with held_back(engine):
            asking = asyncio.create_task(ask())
            await until(lambda: engine.workers.running == 1)
            with pytest.raises(Overloaded), engine.admit_batch():
                pass
            asking.cancel()
            with pytest.raises(asyncio.CancelledError):
                await asking
            with engine.admit_batch():  # at once, not when the photo is done
                pass
        # Closed between two answers instead.
        answers = engine.localize_sequence(START, instants)
        await anext(answers)
        await answers.aclose()
        await engine.localize(replace(job_for(query), options=FAST))
        assert engine.workers.waiting == 0

    with_engine(play)


def test_a_sequence_survives_the_death_of_a_worker_between_two_instants(
    with_engine: WithEngine, query: Query
) -> None:
    async def play(engine: Engine) -> None:
        answers = engine.localize_sequence(START, instants_of([query.image] * 3, query.camera))
        first = await anext(answers)
        (pid,) = engine.workers.pids
        os.kill(pid, signal.SIGKILL)
        await until(lambda: pid not in engine.workers.pids and engine.workers.alive == 1)
        others = [each async for each in answers]
        assert [each.answer.num_inliers for each in others] == [first.answer.num_inliers] * 2

    with_engine(play)


def test_a_version_is_deleted_after_the_requests_that_began_with_it(
    maps_dir: Path, query: Query
) -> None:
    old = MapStore(maps_dir).current_version("room")
    publish(maps_dir, "v2")

    async def play(engine: Engine) -> None:
        with held_back(engine):
            asked = asyncio.create_task(engine.localize(job_for(query, f"room@{old}")))
            await until(lambda: engine.workers.running == 1)
            deleting = asyncio.create_task(engine.delete("room", old))
            await asyncio.sleep(0.2)
            assert not deleting.done()
            with pytest.raises(NotFound):  # it is not to be had any more
                await engine.localize(job_for(query, f"room@{old}"))
        assert (await asked).map_version == old
        await deleting
        assert MapStore(maps_dir).versions("room") == ["v2"]
        publish(maps_dir, "v3")
        await until(lambda: "room@v3" in engine.status.maps)
        with pytest.raises(Conflict) as caught:
            await engine.delete("room", "v3")
        assert caught.value.code == "map.version_in_use"

    with started(maps_dir) as with_engine:
        with_engine(play)


def test_requests_may_delete_the_same_version_at_once(maps_dir: Path) -> None:
    old = MapStore(maps_dir).current_version("room")
    publish(maps_dir, "v2")

    async def play(engine: Engine) -> None:
        deletions = [engine.delete("room", old) for _ in range(3)]
        ended = await asyncio.gather(*deletions, return_exceptions=True)
        assert [type(each) for each in ended if each is not None] == [NotFound, NotFound]
        assert MapStore(maps_dir).versions("room") == ["v2"]

    with started(maps_dir) as with_engine:
        with_engine(play)
