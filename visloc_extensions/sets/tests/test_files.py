from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from visloc.archive import (
    MapStore,
    SetOutline,
    open_map,
    read_any_outline,
    read_set_outline,
    verify_any,
)
from visloc.archive.checks import content_hash, json_text, manifest_hash, sha256_of
from visloc.archive.packed import pack_map, unpack_map
from visloc.errors import Conflict, InvalidInput, MapCorrupt, NotFound
from visloc.geometry import Similarity
from visloc_extensions.sets.coarse import TILE_LISTS
from visloc_extensions.sets.files import MapSet, open_set, verify_set
from visloc_extensions.sets.publishing import publish_set

LARGE = 2**30
SECOND = Similarity(1.0, np.eye(3), np.array([100.0, 0.0, 3.0]))


def quiet(_stage: str, _done: int, _total: int) -> None:
    pass


def renamed(folder: Path, map_id: str, version: str, **changes: Any) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest.update(id=map_id, version=version, **changes)
    manifest["content_hash"] = content_hash(manifest)
    manifest["manifest_hash"] = manifest_hash(manifest)
    (folder / "manifest.json").write_text(json_text(manifest))


@pytest.fixture(scope="module")
def made(built_maps: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with the maps ``hall`` and ``attic``, and the set ``house``; only to be read."""
    root = tmp_path_factory.mktemp("maps with a set")
    store = MapStore(root)
    for map_id in ("hall", "attic"):
        copy = root / ".copy"
        shutil.copytree(MapStore(built_maps).folder("room"), copy)
        renamed(copy, map_id, "v1")
        store.publish(copy, map_id, "v1")
    publish_set(store, "house", [("hall", Similarity.identity()), ("attic@v1", SECOND)], quiet)
    return root


@pytest.fixture
def store(made: Path, tmp_path: Path) -> MapStore:
    return MapStore(Path(shutil.copytree(made, tmp_path / "maps")))


@pytest.fixture
def incoming(store: MapStore, tmp_path: Path) -> Callable[..., Path]:
    """Copies of what the store has, under other names."""
    names: Iterator[str] = iter("abcdefgh")

    def copy(ref: str, map_id: str, version: str, **changes: Any) -> Path:
        target = Path(shutil.copytree(store.folder(ref), tmp_path / next(names)))
        renamed(target, map_id, version, **changes)
        return target

    return copy


def test_a_set_says_what_it_holds(store: MapStore) -> None:
    outline = store.outline("house")

    assert isinstance(outline, SetOutline)
    assert outline.ref == f"house@{store.current_version('house')}"
    assert [tile.ref for tile in outline.tiles] == ["hall@v1", "attic@v1"]
    hall, attic = outline.tiles
    opened = store.open("hall")
    assert hall.content_hash == opened.manifest.content_hash
    assert (hall.images, hall.landmarks) == (len(opened.images), len(opened.landmarks))
    assert hall.size_bytes == opened.size_bytes
    np.testing.assert_allclose(np.array(attic.extent.min) - hall.extent.min, [100, 0, 3])
    np.testing.assert_allclose(outline.photo_boxes[1] - outline.photo_boxes[0], [[100, 0, 3]] * 2)
    assert attic.reach == pytest.approx(hall.reach)
    assert outline.reaches.tolist() == [hall.reach, attic.reach]
    assert outline.manifest.world.metric
    assert outline.manifest.world.extent.min == hall.extent.min
    assert outline.manifest.world.extent.max == attic.extent.max


def test_boxes_hold_landmarks_and_photos(store: MapStore) -> None:
    tile, opened = open_set(store.folder("house")).tiles[0], store.open("hall")
    points = opened.landmarks + np.array(opened.manifest.world.origin)

    assert (np.array(tile.extent.min) <= points.min(axis=0) + 1e-6).all()
    assert (np.array(tile.extent.max) >= points.max(axis=0) - 1e-6).all()
    assert (np.array(tile.extent.min) <= tile.photo_extent.min).all()
    assert (np.array(tile.extent.max) >= tile.photo_extent.max).all()


def test_a_set_is_open_with_its_index(store: MapStore) -> None:
    opened = open_set(store.folder("house"))

    assert isinstance(opened, MapSet)
    photos = len(store.open("hall").images)
    assert opened.coarse.offsets.tolist() == [0, photos, 2 * photos]
    assert opened.coarse.tile_lists == TILE_LISTS
    inverted = opened.coarse.inverted
    # Both tiles are the same map.
    np.testing.assert_array_equal(inverted.sizes[:TILE_LISTS], inverted.sizes[TILE_LISTS:])
    np.testing.assert_array_equal(inverted.centers[:TILE_LISTS], inverted.centers[TILE_LISTS:])
    assert verify_set(opened.path).ref == opened.ref


def test_a_map_and_a_set_are_not_taken_for_each_other(store: MapStore) -> None:
    for wrong in (store.open, lambda ref: open_map(store.folder(ref))):
        with pytest.raises(InvalidInput, match="name one of its tiles") as caught:
            wrong("house")
        assert caught.value.code == "map.is_set"
        assert "hall@v1" in str(caught.value.expected)
    with pytest.raises(InvalidInput) as caught:
        read_set_outline(store.folder("hall"))
    assert caught.value.code == "set.is_map"


def test_an_id_is_that_of_a_map_or_of_a_set(store: MapStore, incoming: Callable[..., Path]) -> None:
    with pytest.raises(Conflict) as caught:
        store.publish(incoming("house", "hall", "v2"), "hall", "v2")
    assert caught.value.code == "set.id_is_map"
    with pytest.raises(Conflict) as caught:
        store.publish(incoming("hall", "house", "v2"), "house", "v2")
    assert caught.value.code == "map.id_is_set"


def test_a_set_is_published_only_beside_its_tiles(
    incoming: Callable[..., Path], tmp_path: Path
) -> None:
    elsewhere = MapStore(tmp_path / "elsewhere")
    for missing in ("hall", "attic"):
        with pytest.raises(NotFound) as caught:
            elsewhere.publish(incoming("house", "house", "v2"), "house", "v2")
        assert (caught.value.code, caught.value.expected) == ("set.tile", f"{missing}@v1")
        elsewhere.publish(incoming(missing, missing, "v1"), missing, "v1")
    assert not (tmp_path / "elsewhere" / "house").exists()

    elsewhere.publish(incoming("house", "house", "v2"), "house", "v2")
    assert elsewhere.ids() == ["attic", "hall", "house"]


def test_a_tile_of_other_content_is_not_that_tile(
    incoming: Callable[..., Path], tmp_path: Path
) -> None:
    elsewhere = MapStore(tmp_path / "elsewhere")
    elsewhere.publish(incoming("hall", "hall", "v1", notes=["another"]), "hall", "v1")

    with pytest.raises(Conflict, match="another tile") as caught:
        elsewhere.publish(incoming("house", "house", "v2"), "house", "v2")
    assert caught.value.code == "set.tile"


def test_tiles_of_other_features_are_refused(
    store: MapStore, incoming: Callable[..., Path]
) -> None:
    manifest = json.loads((store.folder("attic") / "manifest.json").read_text())
    manifest["local_features"]["fingerprint"]["revision"] += 1
    changed = incoming("attic", "attic", "v2", local_features=manifest["local_features"])
    store.publish(changed, "attic", "v2")

    with pytest.raises(
        Conflict, match="attic@v2 and the set have different local features"
    ) as caught:
        publish_set(store, "house", [("hall", Similarity.identity()), ("attic", SECOND)], quiet)
    assert caught.value.code == "set.features"


def test_a_tile_of_a_set_in_use_stays(store: MapStore, incoming: Callable[..., Path]) -> None:
    store.publish(incoming("hall", "hall", "v2"), "hall", "v2")

    with pytest.raises(Conflict, match="tile of a current set") as caught:
        store.remove("hall", "v1")
    assert caught.value.code == "map.in_set"
    assert store.folder("hall@v1").is_dir()

    # Once the current set is one without it, it may go; and the old version does not come back.
    old = store.current_version("house")
    publish_set(store, "house", [("hall", Similarity.identity()), ("attic", SECOND)], quiet)
    store.remove("hall", "v1")
    with pytest.raises(NotFound) as missing:
        store.set_current("house", old)
    assert missing.value.code == "set.tile"
    assert store.current_version("house") != old


def test_without_the_set_its_tiles_may_go(store: MapStore) -> None:
    store.remove("house", store.current_version("house"))
    store.remove("hall", "v1")

    assert store.ids() == ["attic"]


def test_a_packed_set_is_the_same_set(store: MapStore, tmp_path: Path) -> None:
    pack_map(store.folder("house"), tmp_path / "house.zip")
    unpack_map(tmp_path / "house.zip", tmp_path / "again", LARGE)

    assert verify_any(tmp_path / "again").manifest == store.outline("house").manifest


def test_a_set_that_cannot_be_read_frees_no_tile(store: MapStore) -> None:
    house = store.folder("house")
    (house / "manifest.json").write_text("{")

    with pytest.raises(Conflict, match=r"house@.* cannot be read") as caught:
        store.remove("hall", "v1")
    assert caught.value.code == "map.in_set"
    store.remove("house", house.name)
    store.remove("hall", "v1")


def mix_up_files(store: MapStore) -> None:
    """A map with a file of a set, and a set that knows it."""
    hall, house = store.folder("hall"), store.folder("house")
    (hall / "coarse").mkdir()
    shutil.copy(house / "coarse/offsets.npy", hall / "coarse/offsets.npy")
    manifest = json.loads((hall / "manifest.json").read_text())
    manifest["files"]["coarse/offsets.npy"] = json.loads((house / "manifest.json").read_text())[
        "files"
    ]["coarse/offsets.npy"]
    renamed(hall, "hall", "v1", files=manifest["files"])
    hashed = json.loads((hall / "manifest.json").read_text())["content_hash"]
    tiles = json.loads((house / "manifest.json").read_text())["tiles"]
    tiles[0]["content_hash"] = hashed
    renamed(house, "house", house.name, tiles=tiles)


def assert_told_by_manifests(store: MapStore, house: Path) -> None:
    """Which is a map and which a set, also once the set has lost its file."""
    for lost in (False, True):
        if lost:
            (house / "coarse/offsets.npy").unlink()
        for tile in ("hall", "attic"):
            with pytest.raises(Conflict, match="tile of a current set"):
                store.remove(tile, "v1")
    store.remove("house", house.name)
    store.remove("attic", "v1")


def test_what_is_a_set_its_manifest_says(store: MapStore) -> None:
    mix_up_files(store)
    assert_told_by_manifests(store, store.folder("house"))


# Damage


def rewritten(folder: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    """A set whose manifest says something else, with hashes that fit."""
    manifest = json.loads((folder / "manifest.json").read_text())
    for name in manifest["files"]:
        path = folder / name
        if path.exists():
            manifest["files"][name] = {"size": path.stat().st_size, "sha256": sha256_of(path)}
    change(manifest)
    manifest["content_hash"] = content_hash(manifest)
    manifest["manifest_hash"] = manifest_hash(manifest)
    (folder / "manifest.json").write_text(json_text(manifest))
    return folder


def keep(_manifest: dict[str, Any]) -> None:
    pass


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (lambda m: m.update(format_version="3.0"), "map.format_version"),
        (lambda m: m.update(format="visloc-town"), "map.manifest"),
        (lambda m: m.update(tiles=[]), "map.manifest"),
        (lambda m: m["counts"].update(images=3), "map.manifest"),
        (lambda m: m["coarse"].update(lists=0), "map.manifest"),
        (lambda m: m["coarse"].update(lists=64_000), "map.manifest"),
        (lambda m: m["tiles"][0]["set_from_tile"].update(scale=1e-320), "map.manifest"),
        (lambda m: m["tiles"][0]["set_from_tile"].update(scale=1e200), "map.manifest"),
        (lambda m: m["world"]["extent"].update(min=[5] * 3, max=[-5] * 3), "map.manifest"),
        (lambda m: m["tiles"][1]["extent"].update(max=[1e6] * 3), "map.manifest"),
        (lambda m: m["tiles"][1].update(map="hall"), "map.manifest"),
        (lambda m: m["coarse"].update(lists=TILE_LISTS // 2), "map.array"),
        (lambda m: m["coarse"].update(dim=5), "map.array"),
        (lambda m: m["tiles"][0]["set_from_tile"].update(scale=0), "map.manifest"),
        (
            lambda m: m["tiles"][0]["set_from_tile"].update(rotation_wxyz=[1, 1, 0, 0]),
            "map.manifest",
        ),
        (lambda m: m["tiles"][0]["photo_extent"].update(max=[-1e6] * 3), "map.manifest"),
        (lambda m: m["files"].pop("coarse/offsets.npy"), "map.file_missing"),
        (lambda m: m["tiles"].reverse(), None),
    ],
)
def test_a_manifest_that_is_wrong_is_refused(
    store: MapStore, change: Callable[[dict[str, Any]], None], code: str | None
) -> None:
    folder = rewritten(store.folder("house"), change)
    if code is None:  # as good a set
        verify_set(folder)
        return
    with pytest.raises(MapCorrupt) as caught:
        open_set(folder)
    assert caught.value.code == code


def test_every_byte_is_checked(store: MapStore) -> None:
    folder = store.folder("house")
    names = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    for path in names:
        good = path.read_bytes()
        path.write_bytes(good[:-1] + bytes([good[-1] ^ 1]))
        with pytest.raises(MapCorrupt):
            verify_any(folder)
        path.write_bytes(good[:-1])
        with pytest.raises(MapCorrupt):
            verify_any(folder)
        path.write_bytes(good)
    assert verify_any(folder)
    assert len(names) == 6


def test_offsets_are_those_of_the_tiles(store: MapStore) -> None:
    folder = store.folder("house")
    offsets = np.load(folder / "coarse" / "offsets.npy")
    offsets[1] += 1
    np.save(folder / "coarse" / "offsets.npy", offsets)

    with pytest.raises(MapCorrupt) as caught:
        open_set(rewritten(folder, keep))
    assert caught.value.code == "map.range"


def test_lists_are_those_of_the_tiles(store: MapStore) -> None:
    folder = store.folder("house")
    sizes = np.load(folder / "coarse" / "photos.sizes.npy")
    sizes[TILE_LISTS - 1] += 1
    sizes[TILE_LISTS] -= 1
    np.save(folder / "coarse" / "photos.sizes.npy", sizes)

    with pytest.raises(MapCorrupt) as caught:
        open_set(rewritten(folder, keep))
    assert caught.value.code == "map.range"


def test_lists_hold_every_photo_once(store: MapStore) -> None:
    folder = store.folder("house")
    lists = folder / "coarse" / "photos.lists"
    content = lists.read_bytes()
    lists.write_bytes(content[:-8] + bytes(8))  # the last photo is now the first

    with pytest.raises(MapCorrupt) as caught:
        verify_set(rewritten(folder, keep))
    assert caught.value.code == "map.range"


def test_a_set_of_a_format_before_2_0_is_to_be_published_again(store: MapStore) -> None:
    def as_before(manifest: dict[str, Any]) -> None:
        manifest["format_version"] = "1.1"
        del manifest["coarse"]["lists"]
        manifest["coarse"].update(bits=512, centroids=4)

    folder = rewritten(store.folder("house"), as_before)
    with pytest.raises(Conflict, match="mapping set") as caught:
        open_set(folder)
    assert caught.value.code == "set.index"
    assert read_any_outline(folder).manifest.tiles


def test_an_outline_needs_no_arrays(store: MapStore) -> None:
    folder = store.folder("house")
    shutil.rmtree(folder / "coarse")

    assert read_any_outline(folder).ref == f"house@{folder.name}"
    with pytest.raises(MapCorrupt) as caught:
        store.outline("house")
    assert caught.value.code == "map.file_missing"


def test_the_same_set_is_not_published_again(store: MapStore) -> None:
    tiles = [("hall", Similarity.identity()), ("attic", SECOND)]
    before = store.folder("house")

    assert publish_set(store, "house", tiles, quiet) == before
    moved = publish_set(
        store, "house", [tiles[0], ("attic", replace(SECOND, translation=np.zeros(3)))], quiet
    )
    assert moved != before
    assert store.folder("house") == moved
