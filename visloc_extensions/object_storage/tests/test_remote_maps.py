"""Maps in an S3 server, spoken to over a real socket."""

from __future__ import annotations

import itertools
import json
import logging
import math
import shutil
import socket
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import fsspec
import pytest
from moto.server import ThreadedMotoServer

from service.engine.stores import open_store
from visloc.archive import MapStore, open_map, verify_map
from visloc.archive.checks import json_text, manifest_hash
from visloc.errors import (
    Conflict,
    InvalidInput,
    MapCorrupt,
    NotFound,
    StorageFull,
    Unavailable,
)
from visloc_extensions.object_storage import published_index, storage
from visloc_extensions.object_storage.remote_store import RemoteMapStore

LARGE = 2**30
SECRET = "wJalrXUtnFEMI"  # of no account


class S3:
    """A server that can go away and come back with what it had."""

    def __init__(self, port: int = 0) -> None:
        self._server = ThreadedMotoServer("127.0.0.1", port, verbose=False)
        self._server.start()
        self.numbers = itertools.count()
        host, self.port = self._server.get_host_and_port()
        self.url = f"http://{host}:{self.port}"

    def leave(self) -> None:
        self._server.stop()

    def come_back(self) -> None:
        self._server = ThreadedMotoServer("127.0.0.1", self.port, verbose=False)
        self._server.start()


@pytest.fixture(scope="module")
def server() -> Iterator[S3]:
    server = S3()
    yield server
    server.leave()


@pytest.fixture(scope="module")
def s3(server: S3) -> Iterator[S3]:
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("AWS_ENDPOINT_URL", server.url)
        patched.setenv("AWS_ACCESS_KEY_ID", "AKIDEXAMPLE")
        patched.setenv("AWS_SECRET_ACCESS_KEY", SECRET)
        patched.setenv("AWS_DEFAULT_REGION", "us-east-1")
        yield server


@pytest.fixture
def bucket(s3: S3) -> str:
    """A fresh place: a bucket and a folder in it."""
    return fresh_bucket(s3)


def fresh_bucket(s3: S3) -> str:
    name = f"bucket-{next(s3.numbers)}"
    bucket_fs().mkdir(name)
    return f"{name}/maps"


def bucket_fs() -> fsspec.AbstractFileSystem:
    """Another program's look at the storage."""
    return fsspec.filesystem("s3", skip_instance_cache=True, use_listings_cache=False)


@pytest.fixture
def new_store(bucket: str, tmp_path: Path) -> Callable[..., RemoteMapStore]:
    def make(cache: str = "cache", max_bytes: int = LARGE) -> RemoteMapStore:
        return RemoteMapStore(f"s3://{bucket}", tmp_path / cache, max_bytes)

    return make


@pytest.fixture
def store(new_store: Callable[..., RemoteMapStore]) -> RemoteMapStore:
    return new_store()


@pytest.fixture
def make(built_maps: Path, tmp_path: Path) -> Callable[..., Path]:
    """A finished map of any name in a folder of its own."""
    return partial(make_map, built_maps, tmp_path / "made")


def make_map(
    built_maps: Path, folder: Path, version: str, map_id: str = "room", note: str = ""
) -> Path:
    target = folder / f"{map_id}-{version}-{note}"
    shutil.copytree(MapStore(built_maps).folder("room"), target)
    manifest = json.loads((target / "manifest.json").read_text())
    manifest.update(id=map_id, version=version, created=f"2026-01-02T03:04:05+00:00{note}")
    manifest["manifest_hash"] = manifest_hash(manifest)
    (target / "manifest.json").write_text(json_text(manifest))
    return target


@pytest.fixture
def published(store: RemoteMapStore, make: Callable[..., Path]) -> RemoteMapStore:
    """``room`` with ``v1`` and ``v2``, which is current."""
    return publish_two(store, make)


def publish_two(store: RemoteMapStore, make: Callable[..., Path]) -> RemoteMapStore:
    for version in ("v1", "v2"):
        with store.incoming() as incoming:
            shutil.copytree(make(version), incoming / "map")
            store.publish(incoming / "map", "room", version)
    return store


@pytest.fixture(scope="module")
def shared(s3: S3, built_maps: Path, tmp_path_factory: pytest.TempPathFactory) -> RemoteMapStore:
    """As ``published``; only to be read."""
    folder = tmp_path_factory.mktemp("shared")
    store = RemoteMapStore(f"s3://{fresh_bucket(s3)}", folder / "cache", LARGE)
    return publish_two(store, partial(make_map, built_maps, folder))


@pytest.fixture
def new_reader(shared: RemoteMapStore, tmp_path: Path) -> Callable[..., RemoteMapStore]:
    def make(cache: str = "cache", max_bytes: int = LARGE) -> RemoteMapStore:
        return RemoteMapStore(shared.url, tmp_path / cache, max_bytes)

    return make


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is remembered for longer than an instant."""
    monkeypatch.setattr(published_index, "INDEX_S", 0.0)
    monkeypatch.setattr(storage, "AWAY_S", 0.1)


def files_of(bucket: str) -> set[str]:
    return {path.removeprefix(f"{bucket}/") for path in bucket_fs().find(bucket)}


def test_an_empty_place_has_no_maps(store: RemoteMapStore) -> None:
    assert store.ids() == []
    assert store.versions("room") == []
    with pytest.raises(NotFound) as caught:
        store.folder("room")
    assert caught.value.code == "map.unknown"
    assert caught.value.expected == "a map that exists; there is none yet"


def test_a_published_map_is_in_the_storage_as_in_a_folder(
    published: RemoteMapStore, bucket: str, built_maps: Path
) -> None:
    folder = MapStore(built_maps).folder("room")
    files = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}

    assert files_of(bucket) == {
        "room/current",
        *(f"room/{version}/{name}" for version in ("v1", "v2") for name in files),
    }
    assert published.ids() == ["room"]
    assert published.versions("room") == ["v1", "v2"]
    assert published.current_version("room") == "v2"


def test_a_server_with_an_empty_cache_fetches_the_same_bytes(
    shared: RemoteMapStore, new_reader: Callable[..., RemoteMapStore]
) -> None:
    other = new_reader("other")

    fetched = other.folder("room")

    assert fetched.parts[-2:] == ("room", "v2")
    assert verify_map(fetched).manifest == open_map(shared.folder("room@v2")).manifest
    assert other.folder("room@v1").name == "v1"


def test_a_version_is_fetched_once(
    new_reader: Callable[..., RemoteMapStore],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    other = new_reader("other")
    fetches = []
    fetch = other.backend._fetch

    def counted(map_id: str, version: str) -> Path:
        fetches.append((map_id, version))
        return fetch(map_id, version)

    monkeypatch.setattr(other.backend, "_fetch", counted)

    threads = [threading.Thread(target=other.folder, args=("room",)) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    other.folder("room@v2")

    assert fetches == [("room", "v2")]


def test_publication_without_activation_and_rollback(
    published: RemoteMapStore, new_store: Callable[..., RemoteMapStore], make: Callable[..., Path]
) -> None:
    published.publish(make("v3"), "room", "v3", make_current=False)
    assert published.current_version("room") == "v2"
    assert published.versions("room") == ["v1", "v2", "v3"]

    published.set_current("room", "v1")

    assert published.current_version("room") == "v1"
    assert new_store("other").current_version("room") == "v1"


def test_a_map_out_of_use_keeps_its_versions(
    published: RemoteMapStore, new_store: Callable[..., RemoteMapStore]
) -> None:
    for _ in range(2):  # the second time, nothing is left to do
        published.withdraw("room")
        assert published.ids() == []
        assert new_store("other").ids() == []
        assert published.versions("room") == ["v1", "v2"]

    published.set_current("room", "v1")
    assert published.current_version("room") == "v1"


def test_a_version_that_exists_is_not_published_again(
    shared: RemoteMapStore, new_reader: Callable[..., RemoteMapStore], make: Callable[..., Path]
) -> None:
    for store in (shared, new_reader("other")):
        with pytest.raises(Conflict) as caught:
            store.publish(make("v1", note=str(id(store))), "room", "v1")
        assert caught.value.code == "map.version_exists"


def test_what_another_server_changes_is_seen_soon(
    published: RemoteMapStore,
    new_store: Callable[..., RemoteMapStore],
    make: Callable[..., Path],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    other = new_store("other")
    assert other.current_version("room") == "v2"

    published.set_current("room", "v1")
    published.publish(make("v1", "hall"), "hall", "v1")
    assert other.current_version("room") == "v2"  # a few seconds old

    monkeypatch.setattr(published_index, "INDEX_S", 0.0)
    assert other.current_version("room") == "v1"
    assert other.ids() == ["hall", "room"]


def test_what_is_unknown_is_looked_for_sooner(
    published: RemoteMapStore,
    new_store: Callable[..., RemoteMapStore],
    make: Callable[..., Path],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(published_index, "INDEX_S", math.inf)
    monkeypatch.setattr(published_index, "UNKNOWN_S", 0.0)
    other = new_store("other")
    assert other.ids() == ["room"]

    published.publish(make("v1", "hall"), "hall", "v1", make_current=False)
    with pytest.raises(NotFound) as caught:
        other.current_version("hall")
    assert caught.value.code == "map.none_in_use"
    published.set_current("hall", "v1")
    assert other.current_version("hall") == "v1"
    published.publish(make("v3"), "room", "v3")
    assert other.folder("room@v3").name == "v3"

    # Within a second it is not asked again: nobody can make it ask all the time.
    monkeypatch.setattr(published_index, "UNKNOWN_S", math.inf)
    published.publish(make("v1", "cellar"), "cellar", "v1")
    with pytest.raises(NotFound) as caught:
        other.current_version("cellar")
    assert caught.value.code == "map.unknown"


def test_removal_takes_the_version_and_with_the_last_the_map(
    published: RemoteMapStore, bucket: str
) -> None:
    with pytest.raises(Conflict) as caught:
        published.remove("room", "v2")
    assert caught.value.code == "map.version_in_use"

    published.remove("room", "v1")
    assert published.versions("room") == ["v2"]
    with pytest.raises(NotFound):
        published.folder("room@v1")

    published.remove("room", "v2")
    assert published.ids() == []
    assert files_of(bucket) == set()
    with pytest.raises(NotFound) as gone:
        published.remove("room", "v2")
    assert gone.value.code == "map.unknown"


def test_unknown_versions_are_refused_by_name(shared: RemoteMapStore) -> None:
    for change in (shared.set_current, shared.remove):
        with pytest.raises(NotFound, match="v1, v2") as caught:
            change("room", "v3")
        assert caught.value.code == "map.version"
    with pytest.raises(NotFound, match="v1, v2"):
        shared.folder("room@v3")


@pytest.mark.parametrize("ref", ["../room", "room/..", "", "room@../v1", ".hidden", "ro\0om"])
def test_a_reference_that_is_a_path_is_refused(shared: RemoteMapStore, ref: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        shared.folder(ref)
    assert caught.value.code == "map.id"


def test_a_version_that_was_replaced_while_the_server_was_down_is_fetched_anew(
    published: RemoteMapStore, new_store: Callable[..., RemoteMapStore], make: Callable[..., Path]
) -> None:
    other = new_store("other")
    before = open_map(other.folder("room@v1")).manifest
    published.remove("room", "v1")
    published.publish(make("v1", note="1"), "room", "v1", make_current=False)

    after = open_map(new_store("other").folder("room@v1")).manifest

    assert after.created != before.created


# Damage


def test_an_upload_that_was_interrupted_is_not_visible_and_can_be_repeated(
    published: RemoteMapStore,
    new_store: Callable[..., RemoteMapStore],
    make: Callable[..., Path],
    bucket: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    put = published.backend.storage.fs.put_file

    def broken(source: str, target: str, **options: Any) -> None:
        if target.endswith("manifest.json"):
            raise ConnectionError("reset")
        put(source, target, **options)

    with monkeypatch.context() as patched:
        patched.setattr(published.backend.storage.fs, "put_file", broken)
        with pytest.raises(Unavailable) as caught:
            published.publish(make("v3"), "room", "v3")
    assert caught.value.code == "maps.storage_away"
    assert f"{bucket}/room/v3/landmarks.npy" in bucket_fs().find(bucket)
    bucket_fs().pipe_file(f"{bucket}/room/v3/left-over.npy", b"x")

    assert published.versions("room") == ["v1", "v2"]
    assert new_store("other").versions("room") == ["v1", "v2"]
    with pytest.raises(NotFound):
        published.folder("room@v3")

    monkeypatch.setattr(published.backend.storage, "away_until", storage.NEVER)
    published.publish(make("v3", note="again"), "room", "v3")
    assert verify_map(new_store("third").folder("room")).ref == "room@v3"
    assert "room/v3/left-over.npy" not in files_of(bucket)


@pytest.mark.parametrize("name", ["landmarks.npy", "manifest.json", "global/densevlad.npy"])
@pytest.mark.usefixtures("published")
def test_objects_that_were_altered_are_never_served(
    new_store: Callable[..., RemoteMapStore],
    bucket: str,
    name: str,
) -> None:
    fs, place = bucket_fs(), f"{bucket}/room/v2/{name}"
    if not fs.exists(place):
        pytest.skip("the sample's map has no such file")
    content = bytearray(fs.cat_file(place))
    content[len(content) // 2] ^= 0x01
    fs.pipe_file(place, bytes(content))
    other = new_store("other")

    with pytest.raises(MapCorrupt):
        other.folder("room")
    assert not (other.root / "room" / "v2").exists()
    assert other.folder("room@v1").is_dir()


@pytest.mark.parametrize("content", [b"", b"short"])
@pytest.mark.usefixtures("published")
def test_objects_of_another_size_are_not_even_fetched(
    new_store: Callable[..., RemoteMapStore],
    bucket: str,
    content: bytes,
) -> None:
    bucket_fs().pipe_file(f"{bucket}/room/v2/landmarks.npy", content)

    with pytest.raises(MapCorrupt, match=r"landmarks\.npy") as caught:
        new_store("other").folder("room")
    assert caught.value.code == "map.file_size"


@pytest.mark.usefixtures("published")
def test_a_manifest_that_names_files_elsewhere_writes_nothing_there(
    new_store: Callable[..., RemoteMapStore],
    bucket: str,
    tmp_path: Path,
) -> None:
    fs, place = bucket_fs(), f"{bucket}/room/v2/manifest.json"
    manifest = json.loads(fs.cat_file(place))
    manifest["files"]["../../outside"] = {"size": 1, "sha256": "0" * 64}
    fs.pipe_file(place, json.dumps(manifest).encode())

    with pytest.raises(MapCorrupt, match="outside"):
        new_store("other").folder("room")
    assert not list(tmp_path.rglob("outside"))


@pytest.mark.usefixtures("published")
def test_a_damaged_current_object_is_named(
    new_store: Callable[..., RemoteMapStore], bucket: str
) -> None:
    bucket_fs().pipe_file(f"{bucket}/room/current", b"../../etc\n")
    other = new_store("other")

    with pytest.raises(MapCorrupt, match="current") as caught:
        other.folder("room")
    assert caught.value.code == "map.current"
    other.set_current("room", "v1")
    assert other.current_version("room") == "v1"


# Room for copies


def test_the_least_recently_used_copies_make_room(
    published: RemoteMapStore, new_store: Callable[..., RemoteMapStore], make: Callable[..., Path]
) -> None:
    published.publish(make("v3"), "room", "v3")
    one = sum(path.stat().st_size for path in published.folder("room").rglob("*") if path.is_file())
    other = new_store("other", max_bytes=one * 5 // 2)
    other.folder("room@v1")
    time.sleep(0.02)
    other.folder("room@v2")
    time.sleep(0.02)
    other.folder("room@v1")

    other.folder("room@v3")

    assert sorted(path.name for path in (other.root / "room").iterdir()) == ["v1", "v3"]
    assert other.folder("room@v2").is_dir()


def test_a_map_that_is_larger_than_the_room_is_refused(
    new_reader: Callable[..., RemoteMapStore],
) -> None:
    with pytest.raises(StorageFull, match="max_cache_bytes"):
        new_reader("other", max_bytes=1000).folder("room")


# The storage goes away


@pytest.mark.usefixtures("impatient")
def test_copies_go_on_while_the_storage_is_away_and_changes_are_seen_when_it_is_back(
    s3: S3, published: RemoteMapStore, new_store: Callable[..., RemoteMapStore]
) -> None:
    other = new_store("other")
    other.folder("room")
    s3.leave()
    try:
        for _ in range(20):
            assert other.ids() == ["room"]
            assert other.folder("room").name == "v2"
        with pytest.raises(Unavailable) as caught:
            other.folder("room@v1")  # known, but not here
        assert caught.value.code == "maps.storage_away"
        assert caught.value.field == other.url
        for change in (other.set_current, other.remove):
            with pytest.raises(Unavailable):
                change("room", "v1")
    finally:
        s3.come_back()

    time.sleep(0.2)
    published.set_current("room", "v1")
    deadline = time.monotonic() + 10
    while other.current_version("room") != "v1" and time.monotonic() < deadline:
        time.sleep(0.05)
    assert other.folder("room").name == "v1"


def test_a_server_that_starts_while_the_storage_is_away_serves_its_copies(
    s3: S3, new_reader: Callable[..., RemoteMapStore]
) -> None:
    new_reader().folder("room")
    s3.leave()
    try:
        restarted = new_reader()
        assert restarted.ids() == ["room"]
        assert restarted.folder("room").name == "v2"
        with pytest.raises(Unavailable) as caught:
            new_reader("empty").ids()
        assert caught.value.code == "maps.storage_away"
    finally:
        s3.come_back()
    assert new_reader("empty").folder("room").name == "v2"


def test_only_the_first_request_waits_for_a_storage_that_does_not_answer(
    new_reader: Callable[..., RemoteMapStore], monkeypatch: pytest.MonkeyPatch
) -> None:
    new_reader().folder("room")
    monkeypatch.setattr(storage, "CONNECT_TIMEOUT_S", 1)
    monkeypatch.setattr(storage, "READ_TIMEOUT_S", 1)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{silent.getsockname()[1]}")
        store = new_reader()
        assert store.ids() == ["room"]
        monkeypatch.setattr(storage, "AWAY_S", 0.0)
        start = time.monotonic()
        for _ in range(100):
            assert store.folder("room").name == "v2"
        assert time.monotonic() - start < 50  # each would wait for a second or more


def test_credentials_are_never_told(
    s3: S3,
    shared: RemoteMapStore,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    s3.leave()
    try:
        place = shared.url.removeprefix("s3://")
        for url in (shared.url, f"s3://AKIDEXAMPLE:{SECRET}@{place}"):
            with pytest.raises(Unavailable) as caught:
                RemoteMapStore(url, tmp_path / "other", LARGE).ids()
            assert caught.value.field == shared.url
            assert caught.value.__cause__ is None
            assert SECRET not in str(caught.value)
    finally:
        s3.come_back()
    assert SECRET not in caplog.text
    assert "AKID" not in caplog.text
    assert shared.ids() == ["room"]


# Which store


def test_a_folder_and_a_url_are_told_apart(bucket: str, tmp_path: Path) -> None:
    folder = open_store(str(tmp_path), tmp_path, LARGE)
    url = open_store(f"s3://{bucket}", tmp_path, LARGE)

    assert isinstance(folder, MapStore)
    assert isinstance(url, RemoteMapStore)


def test_a_bucket_that_does_not_exist_is_not_created(
    s3: S3, make: Callable[..., Path], tmp_path: Path
) -> None:
    store = RemoteMapStore(f"s3://mistyped-{s3.port}/maps", tmp_path / "cache", LARGE)
    assert store.ids() == []

    with pytest.raises(Unavailable, match="no such bucket"):
        store.publish(make("v1"), "room", "v1")
    assert not bucket_fs().exists(f"mistyped-{s3.port}")


def test_a_url_within_a_url_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="several parts"):
        open_store("simplecache::s3://bucket", tmp_path, LARGE)


def test_a_url_of_an_unknown_protocol_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="nosuch"):
        open_store("nosuch://maps", tmp_path, LARGE)
