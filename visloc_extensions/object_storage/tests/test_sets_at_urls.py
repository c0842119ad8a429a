"""Sets of maps at a URL."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from visloc.archive import MapStore, SetOutline
from visloc.errors import Conflict, NotFound
from visloc_extensions.object_storage.remote_store import RemoteMapStore
from visloc_extensions.sets.files import open_set
from visloc_extensions.sets.tests.test_files import LARGE, assert_told_by_manifests, mix_up_files


def test_a_url_keeps_the_same_rules(incoming: Callable[..., Path], tmp_path: Path) -> None:
    (tmp_path / "bucket").mkdir()

    def remote(name: str) -> RemoteMapStore:
        return RemoteMapStore(f"file://{tmp_path}/bucket", tmp_path / name, LARGE)

    def publish(ref: str, map_id: str, version: str) -> None:
        with server.incoming() as folder:
            made = Path(shutil.copytree(incoming(ref, map_id, version), folder / "map"))
            server.publish(made, map_id, version)

    server = remote("cache")
    with pytest.raises(NotFound, match="the store does not have a tile"):
        publish("house", "house", "v2")
    publish("hall", "hall", "v1")
    publish("attic", "attic", "v1")
    publish("house", "house", "v2")
    with pytest.raises(Conflict, match="has this id"):
        publish("hall", "house", "v3")
    with pytest.raises(Conflict, match="tile of a current set"):
        server.remove("hall", "v1")

    # Another server, without copies: the outline needs no tile, the set no other file.
    other = remote("cache of another")
    outline = other.outline("house")
    assert isinstance(outline, SetOutline)
    assert [tile.ref for tile in outline.tiles] == ["hall@v1", "attic@v1"]
    assert open_set(other.folder("house")).ref == "house@v2"
    other.set_current("house", "v2")
    assert [path.name for path in (tmp_path / "cache of another").glob("*/[!.]*")] == ["house"]
    other.remove("house", "v2")
    other.remove("hall", "v1")


def bucket_of(tmp_path: Path) -> tuple[Path, Callable[[str], RemoteMapStore]]:
    """An empty storage, and what opens it with a folder of copies of this name."""
    bucket = tmp_path / "bucket"
    bucket.mkdir()
    return bucket, lambda cache: RemoteMapStore(f"file://{bucket}", tmp_path / cache, LARGE)


def push(store: RemoteMapStore, made: Path, map_id: str, version: str) -> None:
    with store.incoming() as folder:
        store.publish(Path(shutil.copytree(made, folder / "map")), map_id, version)


def test_a_damaged_copy_of_a_set_does_not_free_its_tiles(store: MapStore, tmp_path: Path) -> None:
    bucket, remote = bucket_of(tmp_path)
    server = remote("cache")
    for map_id in ("hall", "attic", "house"):
        folder = store.folder(map_id)
        push(server, folder, map_id, folder.name)
    (copy,) = (tmp_path / "cache").glob("*/house/*/manifest.json")
    copy.write_bytes(copy.read_bytes()[:-30])

    with pytest.raises(Conflict, match="tile of a current set"):
        server.remove("hall", "v1")

    (damaged,) = bucket.glob("house/*/manifest.json")
    damaged.write_bytes(damaged.read_bytes()[:-30])
    with pytest.raises(Conflict, match=r"house@.* cannot be read") as caught:
        server.remove("hall", "v1")
    assert caught.value.code == "map.in_set"
    assert (bucket / "hall" / "v1" / "manifest.json").is_file()
    server.remove("house", damaged.parent.name)
    server.remove("hall", "v1")


def test_a_set_is_not_taken_for_the_tile_that_a_copy_was(
    store: MapStore, incoming: Callable[..., Path], tmp_path: Path
) -> None:
    _, remote = bucket_of(tmp_path)
    server, other = remote("cache"), remote("cache of another")
    for map_id in ("hall", "attic"):
        push(server, store.folder(map_id), map_id, "v1")
    other.remove("hall", "v1")
    push(other, incoming("hall", "hall", "v1", notes=["another hall"]), "hall", "v1")

    house = store.folder("house")
    with pytest.raises(Conflict, match="the store has another tile") as caught:
        push(remote("cache"), house, "house", house.name)  # that server, started again
    assert caught.value.code == "set.tile"


def test_what_is_a_set_its_manifest_says(store: MapStore, tmp_path: Path) -> None:
    bucket, remote = bucket_of(tmp_path)
    server = remote("cache")
    mix_up_files(store)
    for map_id in ("hall", "attic", "house"):
        push(server, store.folder(map_id), map_id, store.folder(map_id).name)

    assert_told_by_manifests(server, bucket / "house" / store.current_version("house"))
