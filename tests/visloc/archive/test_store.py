from __future__ import annotations

import errno
import fcntl
import json
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from visloc.archive import MapStore, read_any_outline
from visloc.archive.checks import json_text, manifest_hash
from visloc.errors import Conflict, Forbidden, MapCorrupt, NotFound, StorageFull


class Killed(BaseException):
    """What a test does to a step; nothing catches it."""


@pytest.fixture
def store(tmp_path: Path) -> MapStore:
    return MapStore(tmp_path / "maps")


@pytest.fixture
def make(built_maps: Path, tmp_path: Path) -> Callable[..., Path]:
    """A finished map of any name in a folder of its own."""
    source = MapStore(built_maps).folder("room")

    def copy(version: str, map_id: str = "room") -> Path:
        target = tmp_path / f"{map_id}-{version}"
        shutil.copytree(source, target)
        manifest = json.loads((target / "manifest.json").read_text())
        manifest.update(id=map_id, version=version)
        manifest["manifest_hash"] = manifest_hash(manifest)
        (target / "manifest.json").write_text(json_text(manifest))
        return target

    return copy


@pytest.fixture
def two_versions(store: MapStore, make: Callable[..., Path]) -> MapStore:
    """``v1`` and ``v2``, which is current."""
    for version in ("v1", "v2"):
        store.publish(make(version), "room", version)
    return store


def leftovers(store: MapStore) -> list[str]:
    removed = (*store.root.glob(".removed-*"), *store.root.glob("*/.removed-*"))
    return [path.name for path in (*(store.root / ".incoming").glob("*"), *removed)]


def test_naming_the_older_version_rolls_back(two_versions: MapStore) -> None:
    two_versions.set_current("room", "v1")

    assert two_versions.open("room").ref == "room@v1"
    assert two_versions.versions("room") == ["v1", "v2"]


def test_only_a_published_version_becomes_current(two_versions: MapStore) -> None:
    with pytest.raises(NotFound, match="v1, v2") as caught:
        two_versions.set_current("room", "v3")
    assert caught.value.code == "map.version"
    with pytest.raises(NotFound) as unknown:
        two_versions.set_current("hall", "v1")
    assert unknown.value.code == "map.unknown"
    assert two_versions.current_version("room") == "v2"


def test_a_version_published_without_activation_waits(
    store: MapStore, make: Callable[..., Path]
) -> None:
    store.publish(make("v1"), "room", "v1", make_current=False)
    assert store.ids() == []
    assert store.open("room@v1").ref == "room@v1"

    store.set_current("room", "v1")
    store.publish(make("v2"), "room", "v2", make_current=False)
    assert store.ids() == ["room"]
    assert store.current_version("room") == "v1"
    assert store.versions("room") == ["v1", "v2"]


def test_a_map_is_not_published_under_another_name(
    store: MapStore, make: Callable[..., Path]
) -> None:
    with pytest.raises(MapCorrupt) as caught:
        store.publish(make("v1"), "room", "v2")
    assert (caught.value.code, caught.value.expected) == ("map.renamed", "room/v1")
    assert store.versions("room") == []


def test_a_removed_version_is_gone_with_its_files(two_versions: MapStore) -> None:
    two_versions.remove("room", "v1")

    assert two_versions.versions("room") == ["v2"]
    assert not (two_versions.root / "room" / "v1").exists()
    assert leftovers(two_versions) == []
    assert two_versions.open("room").ref == "room@v2"


def test_the_version_in_use_is_not_removed_while_there_are_others(two_versions: MapStore) -> None:
    with pytest.raises(Conflict) as caught:
        two_versions.remove("room", "v2")

    assert (caught.value.code, caught.value.expected) == ("map.version_in_use", "one of v1")
    assert two_versions.open("room").ref == "room@v2"


def test_with_its_last_version_a_map_is_gone(two_versions: MapStore) -> None:
    two_versions.remove("room", "v1")
    two_versions.remove("room", "v2")

    assert two_versions.ids() == []
    assert not (two_versions.root / "room").exists()
    with pytest.raises(NotFound) as caught:
        two_versions.remove("room", "v2")
    assert caught.value.code == "map.unknown"


def test_a_map_out_of_use_keeps_its_versions(two_versions: MapStore) -> None:
    for _ in range(2):  # the second time, nothing is left to do
        two_versions.withdraw("room")
        assert two_versions.ids() == []
        assert two_versions.versions("room") == ["v1", "v2"]
    with pytest.raises(NotFound) as caught:
        two_versions.open("room")
    assert caught.value.code == "map.none_in_use"

    two_versions.set_current("room", "v1")
    assert two_versions.open("room").ref == "room@v1"


def test_no_version_is_removed_where_nothing_says_which_is_in_use(two_versions: MapStore) -> None:
    (two_versions.root / "room" / "current").write_text("??")
    with pytest.raises(MapCorrupt) as caught:
        two_versions.remove("room", "v1")
    assert caught.value.code == "map.current"
    assert two_versions.versions("room") == ["v1", "v2"]


def test_a_full_disk_does_not_keep_a_version_from_being_removed(
    two_versions: MapStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "mkdir", full)
    monkeypatch.setattr(os, "write", full)

    two_versions.remove("room", "v1")

    assert two_versions.versions("room") == ["v2"]


def test_what_is_not_there_is_not_removed(two_versions: MapStore) -> None:
    with pytest.raises(NotFound, match="v1, v2") as caught:
        two_versions.remove("room", "v3")
    assert caught.value.code == "map.version"


def test_a_version_that_is_removed_while_it_is_described_is_not_there(
    two_versions: MapStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    def removed(folder: Path) -> object:
        shutil.rmtree(folder)
        return read_any_outline(folder)

    monkeypatch.setattr("visloc.archive.backends.folder.read_any_outline", removed)
    with pytest.raises(NotFound, match="v2") as caught:
        two_versions.outline("room@v1")
    assert caught.value.code == "map.version"


def test_an_open_map_can_be_read_after_it_was_removed(two_versions: MapStore) -> None:
    opened = two_versions.open("room@v1")
    before = opened.landmarks.sum()

    two_versions.remove("room", "v1")

    assert opened.landmarks.sum() == before


# Two at a time


def test_of_two_that_publish_the_same_version_one_does(
    store: MapStore, make: Callable[..., Path], tmp_path: Path
) -> None:
    first = make("v1")
    folders = [first, *(tmp_path / f"copy-{number}" for number in range(3))]
    for folder in folders[1:]:
        shutil.copytree(first, folder)
    outcomes: list[str] = []

    def publish(folder: Path) -> None:
        try:
            MapStore(store.root).publish(folder, "room", "v1")
            outcomes.append("published")
        except Conflict as conflict:
            outcomes.append(conflict.code)

    threads = [threading.Thread(target=publish, args=(folder,)) for folder in folders]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    assert sorted(outcomes) == ["map.version_exists"] * 3 + ["published"]
    assert store.open("room").ref == "room@v1"


def test_readers_always_find_a_whole_map_while_versions_change(two_versions: MapStore) -> None:
    done = threading.Event()
    failures: list[BaseException] = []
    seen: set[str] = set()

    def read() -> None:
        try:
            while not done.is_set():
                seen.add(MapStore(two_versions.root).open("room").ref)
                assert two_versions.ids() == ["room"]
        except BaseException as failure:
            failures.append(failure)
            raise

    reader = threading.Thread(target=read)
    reader.start()
    for number in range(100):
        two_versions.set_current("room", f"v{number % 2 + 1}")
    done.set()
    reader.join()

    assert not failures
    assert seen <= {"room@v1", "room@v2"}


def test_changes_wait_for_the_change_of_another_process(two_versions: MapStore) -> None:
    changed = threading.Thread(target=two_versions.set_current, args=("room", "v1"))
    with (two_versions.root / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        changed.start()
        changed.join(0.2)
        assert changed.is_alive()
        assert two_versions.current_version("room") == "v2"  # readers do not wait
    changed.join()
    assert two_versions.current_version("room") == "v1"


# Killed at any step


def killing(monkeypatch: pytest.MonkeyPatch, at: int) -> list[str]:
    """Let the ``at``-th of the steps that change something on disk be the last."""
    steps: list[str] = []

    def counted(name: str, original: Callable[..., object]) -> Callable[..., object]:
        def step(*arguments: object, **named: object) -> object:
            if name != "open" or "w" in (*arguments, *named.values()):
                steps.append(name)
                if len(steps) > at:
                    raise Killed
            return original(*arguments, **named)

        return step

    for name in ("mkdir", "rename", "replace", "open", "unlink"):
        monkeypatch.setattr(Path, name, counted(name, getattr(Path, name)))
    monkeypatch.setattr(os, "fsync", counted("fsync", os.fsync))
    monkeypatch.setattr(shutil, "rmtree", counted("rmtree", shutil.rmtree))
    return steps


def state(store: MapStore) -> tuple[list[str], list[str], str | None]:
    """What a reader sees: ids, versions and the current one, which can be opened."""
    current = None
    with suppress(NotFound):
        current = store.current_version("room")
        assert store.open("room").ref == f"room@{current}"
    versions = store.versions("room")
    for version in versions:
        assert store.open(f"room@{version}").ref == f"room@{version}"
    return store.ids(), versions, current


def check_every_step(
    prepared: MapStore, tmp_path: Path, change: Callable[[MapStore, Path], object]
) -> list[tuple[list[str], list[str], str | None]]:
    """Kill a change at each of its steps, look, and repeat it; return the distinct states."""
    seen = []
    for at in range(100):
        root = Path(shutil.copytree(prepared.root, tmp_path / f"killed-{at}" / "maps"))
        store = MapStore(root)
        with pytest.MonkeyPatch.context() as patched:
            killing(patched, at)
            try:
                change(store, root.parent)
                finished = True
            except Killed:
                finished = False
        now = state(store)
        if now not in seen:
            seen.append(now)
        store.sweep()
        assert state(store) == now
        assert leftovers(store) == []
        if finished:
            assert leftovers(store) == []
            return seen
        with suppress(Conflict, NotFound):  # done already
            change(store, root.parent)
        assert leftovers(store) == []
    raise AssertionError("the change never ended")


def test_a_killed_activation_leaves_the_old_or_the_new_version(
    two_versions: MapStore, tmp_path: Path
) -> None:
    states = check_every_step(
        two_versions, tmp_path, lambda store, _: store.set_current("room", "v1")
    )

    assert states == [(["room"], ["v1", "v2"], "v2"), (["room"], ["v1", "v2"], "v1")]


def test_a_killed_removal_leaves_the_version_whole_or_gone(
    two_versions: MapStore, tmp_path: Path
) -> None:
    states = check_every_step(two_versions, tmp_path, lambda store, _: store.remove("room", "v1"))

    assert states == [(["room"], ["v1", "v2"], "v2"), (["room"], ["v2"], "v2")]


def test_a_killed_removal_leaves_the_last_version_whole_or_the_map_gone(
    store: MapStore, make: Callable[..., Path], tmp_path: Path
) -> None:
    store.publish(make("v1"), "room", "v1")

    states = check_every_step(store, tmp_path, lambda store, _: store.remove("room", "v1"))

    assert states == [(["room"], ["v1"], "v1"), ([], [], None)]


def test_a_killed_publication_leaves_the_old_map_or_both(
    store: MapStore, make: Callable[..., Path], tmp_path: Path
) -> None:
    store.publish(make("v1"), "room", "v1")
    finished = make("v2")

    def publish(store: MapStore, _: Path) -> None:
        with store.incoming() as incoming:
            shutil.copytree(finished, incoming / "map", copy_function=os.link)
            store.publish(incoming / "map", "room", "v2")

    states = check_every_step(store, tmp_path, publish)

    assert states == [
        (["room"], ["v1"], "v1"),
        (["room"], ["v1", "v2"], "v1"),
        (["room"], ["v1", "v2"], "v2"),
    ]


# Room for what comes in


def test_incoming_is_empty_and_deleted_in_the_end(store: MapStore) -> None:
    with store.incoming() as first, store.incoming() as second:
        assert first != second
        assert list(first.iterdir()) == []
        (first / "upload.zip").write_bytes(b"x")
    assert leftovers(store) == []
    assert store.ids() == []


def test_incoming_is_deleted_after_an_error(store: MapStore) -> None:
    with pytest.raises(FileNotFoundError), store.incoming() as incoming:
        shutil.copytree(store.root / "absent", incoming / "map")
    assert leftovers(store) == []


def test_what_a_killed_process_left_is_swept_and_what_is_in_use_is_not(store: MapStore) -> None:
    program = (
        "import os, sys; from pathlib import Path; from visloc.archive import MapStore\n"
        "with MapStore(Path(sys.argv[1])).incoming() as incoming:\n"
        "    (incoming / 'upload.zip').write_bytes(b'x')\n"
        "    os.kill(os.getpid(), 9)\n"
    )
    subprocess.run([sys.executable, "-c", program, str(store.root)], check=False)
    assert len(leftovers(store)) == 2  # the folder and its lock

    with store.incoming() as in_use:
        MapStore(store.root).sweep()
        assert in_use.is_dir()
        assert sorted(leftovers(store)) == sorted([in_use.name, f"{in_use.name}.lock"])


@pytest.mark.parametrize(
    ("number", "kind", "code"),
    [
        (errno.ENOSPC, StorageFull, "maps.storage_full"),
        (errno.EDQUOT, StorageFull, "maps.storage_full"),
        (errno.EROFS, Forbidden, "maps.read_only"),
        (errno.EACCES, Forbidden, "maps.read_only"),
    ],
)
def test_a_disk_that_takes_nothing_is_told_as_such(
    store: MapStore, number: int, kind: type[Exception], code: str
) -> None:
    with pytest.raises(kind) as caught, store.incoming():
        raise OSError(number, os.strerror(number))
    assert caught.value.code == code  # type: ignore[attr-defined]
    assert leftovers(store) == []


def test_a_full_disk_while_publishing_leaves_nothing_visible(
    store: MapStore, make: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    finished = make("v1")

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        with pytest.raises(StorageFull):
            store.publish(finished, "room", "v1")

    assert state(store) == ([], [], None)
    store.publish(finished, "room", "v1")
    assert state(store) == (["room"], ["v1"], "v1")


def test_a_damaged_upload_is_never_visible(store: MapStore, make: Callable[..., Path]) -> None:
    finished = make("v1")
    with (finished / "landmarks.npy").open("r+b") as file:
        file.seek(-1, os.SEEK_END)
        file.write(b"\x55")

    with pytest.raises(MapCorrupt, match="altered"):
        store.publish(finished, "room", "v1")
    assert not (store.root / "room").exists()
