"""Uploads and the store, whatever happens in between."""

from __future__ import annotations

import asyncio
import errno
import json
import shutil
import threading
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

from service.engine.uploads import Uploads
from service.values import MapFolder
from visloc.archive import MapStore
from visloc.archive.checks import json_text, manifest_hash
from visloc.archive.packed import pack_map, unpack_map
from visloc.errors import (
    Conflict,
    InvalidInput,
    StorageFull,
    TooLarge,
    Unavailable,
    VislocError,
    refuse,
)


@pytest.fixture(scope="module")
def packed(built_maps: Path, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The map ``room`` as its version ``v1``."""
    return packed_as("room", built_maps, tmp_path_factory.mktemp("packed"))


def packed_as(map_id: str, built_maps: Path, folder: Path) -> bytes:
    copied = Path(shutil.copytree(MapStore(built_maps).folder("room"), folder / "map"))
    manifest = json.loads((copied / "manifest.json").read_text())
    manifest.update(id=map_id, version="v1")
    manifest["manifest_hash"] = manifest_hash(manifest)
    (copied / "manifest.json").write_text(json_text(manifest))
    pack_map(copied, folder / "map.zip")
    return (folder / "map.zip").read_bytes()


@pytest.fixture
def store(tmp_path: Path) -> MapStore:
    (tmp_path / "maps").mkdir()
    return MapStore(tmp_path / "maps")


async def usable(version: MapFolder) -> None:
    """Stands for a worker that could use the map."""
    assert (version.folder / "manifest.json").is_file()


async def chunks_of(content: bytes, size: int = 100_000) -> AsyncIterator[bytes]:
    for start in range(0, len(content), size):
        yield content[start : start + size]


def publish(store: MapStore, content: bytes, max_bytes: int = 10**9) -> None:
    asyncio.run(Uploads(store, max_bytes, usable).publish("room", "v1", chunks_of(content)))


def files_in(store: MapStore) -> list[str]:
    found = (path for path in store.root.rglob("*") if path.is_file())
    return sorted(str(path.relative_to(store.root)) for path in found if path.name != ".lock")


def test_a_version_is_there_in_the_end_and_not_in_use(store: MapStore, packed: bytes) -> None:
    publish(store, packed)

    assert store.versions("room") == ["v1"]
    assert store.ids() == []
    assert store.open("room@v1").manifest.version == "v1"
    assert all(name.startswith("room/v1/") for name in files_in(store))


@pytest.mark.parametrize("name", ["packed", "map", "maps"])
def test_no_name_is_in_the_way_of_the_upload(
    name: str, store: MapStore, built_maps: Path, tmp_path: Path
) -> None:
    content = packed_as(name, built_maps, tmp_path)
    asyncio.run(Uploads(store, 10**9, usable).publish(name, "v1", chunks_of(content)))
    assert store.versions(name) == ["v1"]


def test_nothing_is_taken_of_a_version_that_exists(store: MapStore, packed: bytes) -> None:
    publish(store, packed)

    async def chunks() -> AsyncIterator[bytes]:
        pytest.fail("it was asked for")
        yield b""

    with pytest.raises(Conflict) as caught:
        asyncio.run(Uploads(store, 10**9, usable).publish("room", "v1", chunks()))
    assert caught.value.code == "map.version_exists"


@pytest.mark.parametrize("names", [("..", "v1"), ("room", "../v1"), ("a/b", "v1"), ("room", "")])
def test_nothing_is_taken_under_names_that_are_paths(
    names: tuple[str, str], store: MapStore, packed: bytes
) -> None:
    with pytest.raises(InvalidInput) as caught:
        asyncio.run(Uploads(store, 10**9, usable).publish(*names, chunks_of(packed)))
    assert caught.value.code == "map.id"
    assert files_in(store) == []


def test_no_more_than_the_limit_is_written(store: MapStore) -> None:
    written = 0

    async def chunks() -> AsyncIterator[bytes]:
        nonlocal written
        while True:
            written += 1_000_000
            yield bytes(1_000_000)

    with pytest.raises(TooLarge) as caught:
        asyncio.run(Uploads(store, 10_000_000, usable).publish("room", "v1", chunks()))
    assert caught.value.code == "request.too_large"
    assert written == 11_000_000
    assert files_in(store) == []


@pytest.mark.parametrize("stop", [0, 1, 1000, 500_000, -1])
def test_a_truncated_map_leaves_nothing(stop: int, store: MapStore, packed: bytes) -> None:
    with pytest.raises(InvalidInput) as caught:
        publish(store, packed[:stop])
    assert caught.value.code.startswith("packed.")
    assert files_in(store) == []


def test_a_damaged_map_is_the_senders_mistake(store: MapStore, packed: bytes) -> None:
    for position in range(100, len(packed), len(packed) // 7):
        damaged = bytearray(packed)
        damaged[position] ^= 0xFF
        with pytest.raises(InvalidInput) as caught:
            publish(store, bytes(damaged))
        assert str(store.root) not in str(caught.value)
    assert files_in(store) == []


@pytest.mark.parametrize(
    ("reason", "kind"),
    [
        (refuse("map.unusable", field="room@v1"), InvalidInput),
        (refuse("server.worker_died"), Unavailable),
    ],
)
def test_a_map_that_cannot_be_used_is_refused_and_leaves_nothing(
    reason: VislocError, kind: type[VislocError], store: MapStore, packed: bytes
) -> None:
    async def unusable(version: MapFolder) -> None:
        assert (version.ref, version.is_set) == ("room@v1", False)
        raise reason

    with pytest.raises(kind) as caught:
        asyncio.run(Uploads(store, 10**9, unusable).publish("room", "v1", chunks_of(packed)))
    assert caught.value.code == reason.code
    assert files_in(store) == []


def test_a_map_of_features_that_are_not_here_is_published(store: MapStore, packed: bytes) -> None:
    """They may be installed before it is put into use."""

    async def of_others(version: MapFolder) -> None:
        raise refuse("map.features", field=version.ref, name="sift")

    asyncio.run(Uploads(store, 10**9, of_others).publish("room", "v1", chunks_of(packed)))
    assert store.versions("room") == ["v1"]


def test_a_full_disk_leaves_nothing_and_says_so(
    store: MapStore, packed: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    for target in ("service.engine.uploads.unpack_map", "visloc.archive.packed._write_file"):
        with monkeypatch.context() as patched:
            patched.setattr(target, full)
            with pytest.raises(StorageFull) as caught:
                publish(store, packed)
        assert caught.value.code == "maps.storage_full"
        assert files_in(store) == []
    publish(store, packed)
    assert store.versions("room") == ["v1"]


@pytest.mark.parametrize("step", ["enter", "receive", "unpack", "publish"])
def test_a_cancelled_upload_leaves_all_or_nothing_and_can_be_repeated(
    step: str, store: MapStore, packed: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    reached, goes_on = threading.Event(), threading.Event()

    def held(function: Any) -> Any:
        def waits(*given: Any, **named: Any) -> Any:
            reached.set()
            assert goes_on.wait(10)
            return function(*given, **named)

        return waits

    match step:
        case "enter":
            monkeypatch.setattr(store.backend, "sweep", held(store.backend.sweep))
        case "unpack":
            monkeypatch.setattr("service.engine.uploads.unpack_map", held(unpack_map))
        case "publish":
            monkeypatch.setattr(store, "publish", held(store.publish))

    async def chunks() -> AsyncIterator[bytes]:
        yield packed
        if step == "receive":
            reached.set()
            await asyncio.sleep(10)

    async def run() -> None:
        uploads = Uploads(store, 10**9, usable)
        task = asyncio.create_task(uploads.publish("room", "v1", chunks()))
        assert await asyncio.to_thread(reached.wait, 10)
        task.cancel()
        await asyncio.sleep(0.05)
        assert task.done() == (step == "receive")  # else it waits for its thread
        task.cancel()  # again
        goes_on.set()
        with pytest.raises(asyncio.CancelledError):
            await task
        # What has come whole is published whole, though nobody waits for it any more.
        is_published = step in ("unpack", "publish")
        assert store.versions("room") == (["v1"] if is_published else [])
        assert all(name.startswith("room/v1/") for name in files_in(store))
        if is_published:
            store.open("room@v1")
        else:
            await uploads.publish("room", "v1", chunks_of(packed))

    asyncio.run(run())


def test_one_version_is_taken_once_at_a_time(store: MapStore, packed: bytes) -> None:
    async def run() -> list[VislocError | None]:
        uploads = Uploads(store, 10**9, usable)
        calls = [uploads.publish("room", "v1", chunks_of(packed)) for _ in range(3)]
        found = await asyncio.gather(*calls, return_exceptions=True)
        assert all(each is None or isinstance(each, VislocError) for each in found)
        return found  # type: ignore[return-value]

    found = asyncio.run(run())
    assert sorted("" if each is None else each.code for each in found) == [
        "",
        "map.upload_runs",
        "map.upload_runs",
    ]
