"""Which versions of which maps are served, and what damaged ones do to the others."""

from __future__ import annotations

import asyncio
import json
import logging
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from service.engine import catalog
from service.engine.engine import Engine
from tests.service.engine.engines import (
    Query,
    held_back,
    job_for,
    make,
    publish,
    run,
    started,
    until,
)
from visloc.archive import MapStore
from visloc.errors import Conflict, MapCorrupt, NotFound, Unavailable


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


def test_a_version_that_another_server_replaced_and_deleted_gives_way_to_its_successor(
    maps_dir: Path, query: Query
) -> None:
    async def play() -> None:
        engine = make(maps_dir)
        await engine.start()
        old = (await engine.localize(job_for(query))).map_version
        async with held_back(engine):  # so that it cannot open the new version yet
            publish(maps_dir, "v2")
            MapStore(maps_dir).remove("room", old)
            asking = asyncio.create_task(engine.localize(job_for(query)))
            await asyncio.wait({asking}, timeout=0.5)
        assert (await asking).map_version == "v2"
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


def test_a_version_that_another_server_deletes_while_it_is_read_is_not_there(
    maps_dir: Path, query: Query, monkeypatch: pytest.MonkeyPatch
) -> None:
    publish(maps_dir, "v2", "hall")
    read = catalog.read_any_outline

    def deleted(folder: Path) -> object:
        shutil.rmtree(folder)
        return read(folder)

    async def play(engine: Engine) -> None:
        publish(maps_dir, "v3", "hall")
        monkeypatch.setattr(catalog, "read_any_outline", deleted)
        with pytest.raises(NotFound) as caught:
            await engine.localize(job_for(query, "hall@v3"))
        assert caught.value.code == "map.version"

    with started(maps_dir) as with_engine:
        with_engine(play)


def test_a_version_is_deleted_after_the_requests_that_began_with_it(
    maps_dir: Path, query: Query
) -> None:
    old = MapStore(maps_dir).current_version("room")
    publish(maps_dir, "v2")

    async def play(engine: Engine) -> None:
        async with held_back(engine):
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
