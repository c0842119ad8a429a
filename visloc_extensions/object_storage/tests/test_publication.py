"""Two servers that publish into one S3 bucket at the same time."""

from __future__ import annotations

import json
import logging
import shutil
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pytest
from moto.server import ThreadedMotoServer

from visloc.archive import MapStore, verify_map
from visloc.archive.checks import content_hash, json_text, manifest_hash, sha256_of
from visloc.errors import Conflict
from visloc_extensions.object_storage import publication
from visloc_extensions.object_storage.objects import ObjectBackend
from visloc_extensions.object_storage.remote_store import RemoteMapStore

LARGE = 2**30
NewStore = Callable[[str], RemoteMapStore]


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    server = ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    yield f"http://{host}:{port}"
    server.stop()


@pytest.fixture
def bucket(server: str, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> str:
    monkeypatch.setenv("AWS_ENDPOINT_URL", server)
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "AKIDEXAMPLE")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "of-no-account")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    logging.getLogger("werkzeug").setLevel(logging.WARNING)
    name = f"bucket-{abs(hash(request.node.nodeid))}"
    other_program().mkdir(name)
    return f"{name}/maps"


def other_program() -> fsspec.AbstractFileSystem:
    return fsspec.filesystem("s3", skip_instance_cache=True, use_listings_cache=False)


@pytest.fixture
def new_store(bucket: str, tmp_path: Path) -> NewStore:
    return lambda cache: RemoteMapStore(f"s3://{bucket}", tmp_path / cache, LARGE)


@pytest.fixture
def make(built_maps: Path, tmp_path: Path) -> Callable[..., Path]:
    """A finished map ``room`` in a folder of its own; with another ``shift``, another map."""

    def copy(version: str, shift: float = 0.0) -> Path:
        folder = tmp_path / f"made-{version}-{shift}"
        shutil.copytree(MapStore(built_maps).folder("room"), folder)
        path = folder / "landmarks.npy"
        np.save(path, np.load(path) + np.float32(shift))
        manifest = json.loads((folder / "manifest.json").read_text())
        manifest.update(version=version, notes=[str(shift)])
        manifest["files"]["landmarks.npy"]["sha256"] = sha256_of(path)
        manifest["content_hash"] = content_hash(manifest)
        manifest["manifest_hash"] = manifest_hash(manifest)
        (folder / "manifest.json").write_text(json_text(manifest))
        return folder

    return copy


def publish(store: MapStore, made: Path, version: str, **options: Any) -> str:
    """``published``, or the code of the conflict."""
    try:
        with store.incoming() as folder:
            incoming = Path(shutil.copytree(made, folder / "map"))
            store.publish(incoming, "room", version, **options)
    except Conflict as conflict:
        return conflict.code
    return "published"


def meanwhile(store: RemoteMapStore, step: int, action: Callable[[], None]) -> None:
    """Let something happen just before a store writes its ``step``-th object."""
    assert isinstance(store.backend, ObjectBackend)
    fs = store.backend.storage.fs
    count = 0

    def before(write: Callable[..., Any]) -> Callable[..., Any]:
        def written(*given: Any, **options: Any) -> Any:
            nonlocal count
            count += 1
            if count == step:
                action()
            return write(*given, **options)

        return written

    fs.put_file, fs.pipe_file = before(fs.put_file), before(fs.pipe_file)


def test_two_versions_that_are_published_at_once_are_both_there(
    new_store: NewStore, make: Callable[..., Path]
) -> None:
    made = {version: make(version, shift) for version, shift in (("v1", 0.0), ("v2", 1.0))}
    outcomes: list[str] = []
    threads = [
        threading.Thread(
            target=lambda version=version: outcomes.append(  # type: ignore[misc]
                publish(new_store(version), made[version], version)
            )
        )
        for version in made
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    reader = new_store("reader")
    assert outcomes == ["published", "published"]
    assert reader.current_version("room") in made
    for version in made:
        assert verify_map(reader.folder(f"room@{version}")).ref == f"room@{version}"


@pytest.mark.parametrize("shift", [0.0, 1.0])
# Two for what the server can do, then file by file; 14 is the landmarks, 19 the manifest.
@pytest.mark.parametrize("step", [1, 2, 9, 14, 15, 19, 20])
def test_of_two_that_publish_the_same_version_one_does_at_whatever_step_the_other_comes(
    new_store: NewStore, make: Callable[..., Path], step: int, shift: float
) -> None:
    first, second = make("v1"), make("v1", shift) if shift else make("v1 again")
    if not shift:  # the same bytes
        shutil.rmtree(second)
        shutil.copytree(first, second)
    slow, fast = new_store("slow"), new_store("fast")
    outcomes: list[str] = []
    meanwhile(slow, step, lambda: outcomes.append(publish(fast, second, "v1")))

    outcomes.append(publish(slow, first, "v1"))

    # The faster one loses where it meets other bytes of the slower one.
    early = "map.upload_runs" if step > 14 and shift and step < 20 else "map.version_exists"
    assert sorted(outcomes) == [early, "published"]
    reader = new_store("reader")
    opened = verify_map(reader.folder("room"))
    won = second if outcomes[0] == "published" else first
    assert opened.manifest == verify_map(won).manifest


def test_what_the_loser_wrote_in_addition_is_deleted(
    new_store: NewStore, make: Callable[..., Path], bucket: str
) -> None:
    slow, fs = new_store("slow"), other_program()
    meanwhile(slow, 5, lambda: fs.pipe_file(f"{bucket}/room/v1/aaa.npy", b"of another map"))

    assert publish(slow, make("v1"), "v1") == "published"
    assert not other_program().exists(f"{bucket}/room/v1/aaa.npy")


def test_other_bytes_stop_a_publication_until_nobody_adds_to_them_for_long(
    new_store: NewStore, make: Callable[..., Path], bucket: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    left_over = f"{bucket}/room/v1/landmarks.npy"
    other_program().pipe_file(left_over, b"of another map")
    store, made = new_store("cache"), make("v1")

    assert publish(store, made, "v1") == "map.upload_runs"
    assert other_program().cat_file(left_over) == b"of another map"
    assert store.versions("room") == []

    monkeypatch.setattr(publication, "LEFTOVER_S", -1.0)
    assert publish(store, made, "v1") == "published"
    assert verify_map(new_store("reader").folder("room")).ref == "room@v1"


def test_an_update_does_not_replace_a_version_that_came_into_use_meanwhile(
    new_store: NewStore, make: Callable[..., Path]
) -> None:
    one, two = new_store("one"), new_store("two")
    assert publish(one, make("v1"), "v1") == "published"
    outcomes: list[str] = []
    update, other = make("v2", 1.0), make("v3", 2.0)
    # The last object is ``current``.
    files = sum(path.is_file() for path in update.rglob("*"))
    meanwhile(one, files + 1, lambda: outcomes.append(publish(two, other, "v3", based_on="v1")))

    outcomes.append(publish(one, update, "v2", based_on="v1"))

    assert outcomes == ["published", "map.outdated"]
    reader = new_store("reader")
    assert reader.current_version("room") == "v3"
    assert verify_map(reader.folder("room@v2")).ref == "room@v2"
    assert publish(one, make("v4", 3.0), "v4", based_on="v3") == "published"


def test_an_answer_that_was_lost_makes_no_conflict(
    new_store: NewStore, make: Callable[..., Path]
) -> None:
    store = new_store("cache")
    assert isinstance(store.backend, ObjectBackend)
    fs = store.backend.storage.fs
    put, pipe = fs.put_file, fs.pipe_file

    def twice(write: Callable[..., Any]) -> Callable[..., Any]:
        def repeated(*given: Any, **options: Any) -> Any:
            write(*given, **options)
            return write(*given, **options)

        return repeated

    fs.put_file, fs.pipe_file = twice(put), twice(pipe)

    assert publish(store, make("v1"), "v1") == "published"
    assert publish(store, make("v2", 1.0), "v2", based_on="v1") == "published"
    assert verify_map(new_store("reader").folder("room")).ref == "room@v2"


def test_a_storage_without_conditions_is_named_in_the_log_and_works(
    new_store: NewStore,
    make: Callable[..., Path],
    caplog: pytest.LogCaptureFixture,
    tmp_path: Path,
) -> None:
    ignoring = new_store("cache")
    assert isinstance(ignoring.backend, ObjectBackend)
    fs = ignoring.backend.storage.fs
    put = fs.put_file

    def overwriting(*given: Any, **options: Any) -> Any:
        return put(*given, **{**options, "mode": "overwrite"})

    fs.put_file = overwriting
    (tmp_path / "bucket").mkdir()
    folder = RemoteMapStore(f"file://{tmp_path}/bucket", tmp_path / "other cache", LARGE)

    for store in (ignoring, folder):
        caplog.clear()
        assert publish(store, make("v1"), "v1") == "published"
        assert publish(store, make("v2", 1.0), "v2", based_on="v1") == "published"
        warnings = [record.message for record in caplog.records if record.levelname == "WARNING"]
        assert warnings == [
            f"{store.url} has no conditional writes: publish from one server at a time"
        ]
        assert verify_map(store.folder("room")).ref == "room@v2"
        shutil.rmtree(tmp_path / "made-v1-0.0")
        shutil.rmtree(tmp_path / "made-v2-1.0")


def test_processes_with_the_same_copies_do_not_take_each_other_s_for_theirs(
    new_store: NewStore, make: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    mine, other = new_store("same"), new_store("same")
    backend = mine.backend
    assert isinstance(backend, ObjectBackend)
    make_room = backend.copies.make_room

    def other_is_faster(size: int) -> None:
        make_room(size)
        assert isinstance(other.backend, ObjectBackend)
        with other.incoming() as incoming:
            kept = Path(shutil.copytree(make("v1", 1.0), incoming / "map"))
            other.backend.copies.keep(kept, "room", "v1")

    monkeypatch.setattr(backend.copies, "make_room", other_is_faster)
    with mine.incoming() as incoming, pytest.raises(Conflict) as caught:
        mine.publish(Path(shutil.copytree(make("v1"), incoming / "map")), "room", "v1")
    assert caught.value.code == "map.version_exists"
    assert mine.ids() == []
