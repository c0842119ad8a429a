from __future__ import annotations

import asyncio
import json
import logging
import shutil
import threading
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
import pytest

from service import engine as engine_module
from service import loaded_maps
from service.engine import Engine
from service.jobs import LocalizeJob
from visloc.archive import MapStore
from visloc.errors import Conflict, InvalidInput, MapCorrupt, NotFound, Overloaded, Unavailable
from visloc.geometry import Camera
from visloc.images import ImageLimits
from visloc.localizer import Localizer
from visloc.types import Localized, LocalizeOptions

T = TypeVar("T")


class Query(Protocol):
    image: bytes
    camera: Camera


def make(maps_dir: Path, **settings: Any) -> Engine:
    return Engine(MapStore(maps_dir), limits=ImageLimits(), **settings)


def run(coroutine: Coroutine[Any, Any, T]) -> T:
    return asyncio.run(coroutine)


def job_for(query: Query, ref: str = "room") -> LocalizeJob:
    return LocalizeJob((ref,), query.image, query.camera, LocalizeOptions())


def publish(maps_dir: Path, version: str, map_id: str = "room") -> None:
    """Make a copy of the current version and switch to it."""
    source = MapStore(maps_dir).folder("room")
    target = maps_dir / map_id / version
    shutil.copytree(source, target)
    manifest = json.loads((target / "manifest.json").read_text())
    manifest |= {"id": map_id, "version": version}
    (target / "manifest.json").write_text(json.dumps(manifest))
    (maps_dir / map_id / "current").write_text(version)


def test_an_answer_names_its_map_and_times_every_stage(maps_dir: Path, query: Query) -> None:
    async def play() -> None:
        engine = make(maps_dir)
        await engine.start()
        found = await engine.localize(job_for(query))
        engine.close()

        assert isinstance(found.answer, Localized)
        assert found.map_id == "room"
        assert found.map_version == MapStore(maps_dir).current_version("room")
        seconds = found.answer.evidence.seconds
        assert list(seconds)[:4] == ["queued", "open_map", "decode", "local_features"]
        assert all(value >= 0 for value in seconds.values())

    run(play())


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
        engine.close()
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

        assert (await engine.localize(job_for(query))).map_version == "v2"
        assert (await engine.localize(job_for(query, "hall"))).map_id == "hall"
        assert (await engine.map("room")).manifest.version == "v2"
        assert [m.manifest.id for m in await engine.maps()] == ["hall", "room"]
        assert engine.status.maps == ("hall@v1", "room@v2")
        # The older version is still there for those who name it.
        assert (await engine.localize(job_for(query, f"room@{old}"))).map_version == old
        engine.close()

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

        for _ in range(3):
            assert (await engine.localize(job_for(query))).map_version == old
        assert (await engine.map("room")).manifest.version == old
        assert [m.manifest.version for m in await engine.maps()] == [old]
        with pytest.raises(MapCorrupt):
            await engine.localize(job_for(query, "room@v2"))

        (maps_dir / "room" / "current").write_text(old)
        publish(maps_dir, "v3")
        assert (await engine.localize(job_for(query))).map_version == "v3"
        engine.close()

    with caplog.at_level(logging.ERROR):
        run(play())
    (record,) = caplog.records
    assert "room@v2 cannot take over" in record.message
    assert "landmarks.npy" in record.message


def test_a_broken_map_does_not_keep_the_others_from_being_served(
    maps_dir: Path, query: Query, caplog: pytest.LogCaptureFixture
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
        assert [m.manifest.id for m in await engine.maps()] == ["room"]
        await engine.localize(job_for(query))
        with pytest.raises(MapCorrupt):
            await engine.localize(job_for(query, "hall"))

        manifest.write_bytes(good)
        await engine.localize(job_for(query, "hall"))
        assert engine.status.not_loaded == {}
        engine.close()

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


@pytest.mark.parametrize("damage", [without_an_array, with_a_folder_as_manifest])
def test_whatever_a_damaged_map_breaks_the_others_are_served(
    damage: Callable[[Path], None], maps_dir: Path, query: Query, caplog: pytest.LogCaptureFixture
) -> None:
    async def play() -> None:
        publish(maps_dir, "v1", map_id="hall")
        damage(maps_dir / "hall" / "v1")
        engine = make(maps_dir)
        await engine.start()

        assert engine.status.ready
        assert engine.status.not_loaded.keys() == {"hall"}
        assert engine.status.not_loaded["hall"].code == "map.unusable"
        assert "room" in [m.manifest.id for m in await engine.maps()]
        assert (await engine.localize(job_for(query))).map_id == "room"
        with pytest.raises(MapCorrupt):
            await engine.localize(job_for(query, "hall"))

        before = (await engine.localize(job_for(query))).map_version
        publish(maps_dir, "v2")
        damage(maps_dir / "room" / "v2")
        assert (await engine.localize(job_for(query))).map_version == before
        assert engine.status.not_loaded["room"].field == "room@v2"
        engine.close()

    run(play())
    assert "Traceback" in caplog.text


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

        assert (await engine.localize(job_for(query))).map_version == old
        assert engine.status.maps == (f"room@{old}",)
        assert "v2" in str(engine.status.not_loaded["room"])

        landmarks.with_name("away").rename(landmarks)
        assert (await engine.localize(job_for(query))).map_version == old
        monkeypatch.setattr(loaded_maps, "RETRY_AFTER_S", 0.0)
        assert (await engine.localize(job_for(query))).map_version == "v2"
        assert engine.status.not_loaded == {}
        engine.close()

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
        assert (await engine.map("room")).manifest.version == old
        assert engine.status.not_loaded["room"].code == "map.current"
        engine.close()

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
        assert [ref.partition("@")[0] for ref in engine.status.maps] == ["room"]
        assert engine.status.not_loaded == {}
        with pytest.raises(NotFound):
            await engine.localize(job_for(query, "hall"))
        engine.close()

    run(play())


def test_a_loaded_map_is_described_without_opening_it_again(
    maps_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def play() -> None:
        engine = make(maps_dir)
        await engine.start()
        monkeypatch.setattr(MapStore, "open", None)
        by_id = await engine.map("room")
        assert await engine.map(by_id.ref) is by_id
        engine.close()

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
        engine.close()

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
        engine._ready = True  # nothing needs to be loaded for this
        for call in (engine.localize(job_for(query, ref)), engine.map(ref)):
            with pytest.raises(kind) as caught:
                await call
            assert getattr(caught.value, "code", None) == code
        engine.close()

    run(play())


class Gate:
    """Holds back the work of the engine until it is opened."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.opened, self.entered = threading.Event(), threading.Semaphore(0)
        self.count = 0
        read_photo = engine_module.read_photo

        def waiting(*arguments: Any) -> Any:
            self.count += 1
            self.entered.release()
            assert self.opened.wait(30)
            return read_photo(*arguments)

        monkeypatch.setattr(engine_module, "read_photo", waiting)


def test_one_photo_too_many_is_refused_at_once(
    built_maps: Path, query: Query, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def play() -> None:
        engine = make(built_maps, workers=1, max_queue=2)
        await engine.start()
        gate = Gate(monkeypatch)
        accepted = [asyncio.create_task(engine.localize(job_for(query))) for _ in range(3)]
        await asyncio.sleep(0)

        with pytest.raises(Overloaded) as caught:
            await engine.localize(job_for(query))
        assert caught.value.code == "server.busy"

        gate.opened.set()
        answers = await asyncio.gather(*accepted)
        assert len(answers) == 3
        assert answers[2].answer.evidence.seconds["queued"] > 0
        await engine.localize(job_for(query))  # there is room again
        engine.close()

    run(play())


def test_a_photo_whose_caller_left_is_dropped_and_gives_back_its_place(
    built_maps: Path, query: Query, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def play() -> None:
        engine = make(built_maps, workers=1, max_queue=1)
        await engine.start()
        gate = Gate(monkeypatch)
        running, waiting = (asyncio.create_task(engine.localize(job_for(query))) for _ in range(2))
        await asyncio.to_thread(gate.entered.acquire)

        waiting.cancel()
        with pytest.raises(asyncio.CancelledError):
            await waiting
        after = asyncio.create_task(engine.localize(job_for(query)))
        await asyncio.sleep(0)
        gate.opened.set()
        await asyncio.gather(running, after)
        assert gate.count == 2
        engine.close()

    run(play())


def test_workers_work_at_the_same_time(
    built_maps: Path, query: Query, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def play() -> None:
        engine = make(built_maps, workers=2, max_queue=0)
        await engine.start()
        gate = Gate(monkeypatch)
        tasks = [asyncio.create_task(engine.localize(job_for(query))) for _ in range(2)]
        for _ in range(2):
            assert await asyncio.to_thread(gate.entered.acquire, timeout=10)
        gate.opened.set()
        await asyncio.gather(*tasks)
        engine.close()

    run(play())


def test_one_extractor_serves_all_maps_that_use_it(
    maps_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    publish(maps_dir, "v1", map_id="hall")
    used = []

    class Recording(Localizer):
        def __init__(self, opened: Any, extractor: Any) -> None:
            used.append(extractor)
            super().__init__(opened, extractor)

    monkeypatch.setattr(loaded_maps, "Localizer", Recording)

    async def play() -> None:
        engine = make(maps_dir)
        await engine.start()
        engine.close()

    run(play())
    assert len(used) == 2
    assert used[0] is used[1]


def test_no_maps_at_all_is_a_state_to_be_ready_in(tmp_path: Path) -> None:
    async def play() -> None:
        engine = make(tmp_path / "absent")
        await engine.start()
        assert engine.status.ready
        assert await engine.maps() == []
        engine.close()

    run(play())
