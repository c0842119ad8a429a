"""A folder of photos of two painted rooms becomes two maps, each of which localizes its room."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapping.frames.anchor import align_poses
from mapping.maps.editing import content_of
from mapping.methods.sfm_settings import SfmSettings
from mapping.own_test.publishing import write_content
from mapping.pipeline.build import build_map
from mapping.pipeline.pieces import (
    WrittenMap,
    ids_of_pieces,
    note_of_piece,
    publish_pieces,
    refuse_long_id,
    use_version,
    without_pieces,
)
from mapping.pipeline.settings import BuildSettings
from mapping.sample import write_sample
from visloc.archive import Map, MapStore, open_map
from visloc.archive.schema import PIECES, Doubt
from visloc.errors import Conflict, InvalidInput, NotFound
from visloc.features import make_local_features
from visloc.geometry import Pose
from visloc.kapture import FileRecord, read_dataset, write_dataset
from visloc.localization.localizer import Localizer
from visloc.options import LocalizeOptions
from visloc.photos.reading import read_photo_file
from visloc.types import Localized

# Photos of the first and of the second room.
IN_ROOM = (16, 12)
SIZE = (320, 240)


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Samples of two rooms of one shape with other pictures."""
    folder = tmp_path_factory.mktemp("rooms")
    for seed, images in enumerate(IN_ROOM):
        write_sample(folder / str(seed), images=images, size=SIZE, seed=seed)
    return folder / "0", folder / "1"


def in_one_folder(samples: Sequence[Path], root: Path) -> Path:
    """Write the mapping photos of samples as one dataset that knows no pose."""
    records = []
    for number, sample in enumerate(samples):
        source = read_dataset(sample / "mapping")
        for record in source.images:
            path = f"{number}/{record.path}"
            target = root / "sensors" / "records_data" / path
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source.path_of(record), target)
            at = record.timestamp + number * 10**7
            records.append(FileRecord(at, record.sensor_id, path))
    cameras = {one.id: one for one in source.sensors.values() if one.kind == "camera"}
    write_dataset(
        replace(
            source,
            root=root,
            sensors=cameras,
            rigs={},
            trajectories={},
            images=tuple(records),
            depth_maps=(),
            gnss=(),
        )
    )
    return root


def build(dataset: Path, maps: Path, **changes: object) -> Map:
    values: dict[str, Any] = {
        "method": "sfm",
        "local_features": "xfeat",
        "max_keypoints": 1500,
        "sfm": SfmSettings(poses="estimate"),
    } | changes
    settings = BuildSettings(dataset, "home", maps, **values)
    return open_map(build_map(settings, lambda *_: None))


@pytest.fixture(scope="module")
def built(rooms: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with the maps of both rooms."""
    folder = tmp_path_factory.mktemp("two rooms")
    build(in_one_folder(rooms, folder / "dataset"), folder / "maps", accept=True)
    return folder / "maps"


@pytest.mark.slow
def test_each_room_is_a_map_of_its_own(built: Path) -> None:
    store = MapStore(built)
    assert store.ids() == ["home", "home-2"]
    largest, other = store.open("home"), store.open("home-2")
    assert {image.name[0] for image in largest.images} == {"0"}
    assert {image.name[0] for image in other.images} == {"1"}
    assert len(largest.images) == IN_ROOM[0]
    assert len(other.images) == IN_ROOM[1]
    for opened in (largest, other):
        assert opened.manifest.parts.own_test is not None
        assert opened.manifest.world.anchor is not None
        assert opened.manifest.world.anchor.kind == "none"


@pytest.mark.slow
def test_the_largest_names_the_other(built: Path) -> None:
    store = MapStore(built)
    largest, other = store.open("home"), store.open("home-2")
    assert largest.manifest.pieces == [other.ref]
    assert other.manifest.pieces == []
    assert any(f"{other.ref} of {IN_ROOM[1]} photos" in n for n in largest.manifest.notes)
    assert note_of_piece("home-2", "home") in other.manifest.notes


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 1])
def test_queries_of_each_room_are_localized_by_its_map(
    built: Path, rooms: tuple[Path, Path], number: int
) -> None:
    store, extractor = MapStore(built), make_local_features("xfeat")
    own, other = (store.open(("home", "home-2")[each]) for each in (number, 1 - number))
    moved, given = poses_of(own), truths(rooms[number] / "mapping")
    world_from_map = align_poses(
        list(moved.values()), [given[name.partition("/")[2]] for name in moved]
    )
    queries = read_dataset(rooms[number] / "query")
    errors = []
    for record in queries.images:
        photo = read_photo_file(queries.path_of(record))
        camera, truth = queries.sensors[record.sensor_id].camera, queries.pose(record)
        assert truth is not None
        answer = Localizer(own, extractor).localize(photo, camera, LocalizeOptions())
        assert isinstance(answer, Localized)
        there = world_from_map.apply(answer.cam_from_world.center[None])[0]
        errors.append(float(np.linalg.norm(there - truth.center)))
        # The rooms look alike, but asked together, their maps do not explain it equally well.
        elsewhere = Localizer(other, extractor).localize(photo, camera, LocalizeOptions())
        assert elsewhere.evidence.num_inliers < answer.evidence.num_inliers / 2
    assert max(errors) < 0.05


def poses_of(opened: Map) -> dict[str, Pose]:
    return {
        image.name: Pose.from_quaternion(pose[:4], pose[4:])
        for image, pose in zip(opened.images, opened.image_poses, strict=True)
    }


def truths(folder: Path) -> dict[str, Pose]:
    dataset = read_dataset(folder)
    return {r.path: pose for r in dataset.images if (pose := dataset.pose(r)) is not None}


Written = Callable[..., WrittenMap]


@pytest.fixture
def written(sample_map: Map, tmp_path: Path) -> Written:
    """Write a version of a map without publishing it."""

    def write(
        map_id: str, *beside: WrittenMap, doubtful: bool = False, is_build: bool = True
    ) -> WrittenMap:
        folder = tmp_path / "incoming" / map_id
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        notes = () if map_id == "home" else (note_of_piece(map_id, "home"),)
        doubts = [Doubt(kind="own_test", message="it is wrong", photos=())] * doubtful
        content = replace(content_of(sample_map), notes=notes)
        if map_id == "home" and is_build:
            pieces = {PIECES: [each.ref for each in beside]}
            content = replace(content, settings={**content.settings, **pieces})
        version = write_content(folder, content, map_id, examine=lambda _: doubts)
        return WrittenMap(folder, map_id, version, len(sample_map.images))

    return write


@pytest.fixture(scope="module")
def sample_map(build_sample: Callable[..., Map]) -> Map:
    return build_sample()


@pytest.fixture
def store(tmp_path: Path) -> MapStore:
    return MapStore(tmp_path / "store")


def publish(store: MapStore, *pieces: WrittenMap, accept: bool = False) -> None:
    publish_pieces(store, pieces, accept=accept)


def in_use(store: MapStore) -> dict[str, str]:
    return {map_id: store.current_version(map_id) for map_id in store.ids()}


def test_pieces_replace_those_of_the_build_before(store: MapStore, written: Written) -> None:
    publish(store, written("home"), written("home-2"), written("home-3"))
    again = written("home"), written("home-2")
    publish(store, *again)
    assert in_use(store) == {one.map_id: one.version for one in again}
    assert len(store.versions("home-3")) == 1


def test_a_build_in_doubt_changes_nothing_that_is_in_use(store: MapStore, written: Written) -> None:
    publish(store, written("home"), written("home-2"), written("home-3"))
    before = in_use(store)
    again = written("home", doubtful=True), written("home-2")
    publish(store, *again)
    assert in_use(store) == before
    assert len(store.versions("home-2")) == 2
    publish(store, written("home", doubtful=True), written("home-2"), accept=True)
    assert in_use(store).keys() == {"home", "home-2"}


def test_a_piece_in_doubt_is_not_put_into_use_nor_left_as_it_was(
    store: MapStore, written: Written
) -> None:
    publish(store, written("home"), written("home-2"))
    again = written("home"), written("home-2", doubtful=True)
    publish(store, *again)
    assert in_use(store) == {"home": again[0].version}
    assert again[1].version in store.versions("home-2")


def test_to_use_a_build_in_doubt_replaces_the_pieces_of_the_build_before(
    store: MapStore, written: Written
) -> None:
    old = written("home-2"), written("home-3")
    before = written("home", *old)
    publish(store, before, *old)
    one, doubtful = written("home-2"), written("home-4", doubtful=True)
    again = written("home", one, doubtful, doubtful=True)
    publish(store, again, one, doubtful)
    assert in_use(store) == {each.map_id: each.version for each in (before, *old)}
    assert use_version(store, "home", again.version) == [again.ref, one.ref]
    assert in_use(store) == {"home": again.version, "home-2": one.version}
    # And back again.
    assert use_version(store, "home", before.version) == [before.ref, *(each.ref for each in old)]
    assert in_use(store) == {each.map_id: each.version for each in (before, *old)}


def test_to_use_a_version_that_no_build_made_leaves_pieces_alone(
    store: MapStore, written: Written
) -> None:
    piece = written("home-2")
    first = written("home", piece)
    publish(store, first, piece)
    updated = written("home", is_build=False)
    store.publish(updated.folder, "home", updated.version)
    assert use_version(store, "home", first.version) == [first.ref, piece.ref]
    assert use_version(store, "home", updated.version) == [updated.ref]
    assert use_version(store, "home-2", piece.version) == [piece.ref]
    assert in_use(store) == {"home": updated.version, "home-2": piece.version}
    with pytest.raises(NotFound):
        use_version(store, "home", "none")


def test_a_removed_piece_is_not_missed(store: MapStore, written: Written) -> None:
    piece, other = written("home-2"), written("home-3")
    first = written("home", piece, other)
    publish(store, first, piece, other)
    again = written("home")
    publish(store, again)
    store.remove("home-2", piece.version)
    assert use_version(store, "home", first.version) == [first.ref, other.ref]


def test_what_is_made_of_a_build_does_not_name_its_pieces() -> None:
    assert without_pieces({"pairs": "retrieval", PIECES: ["home-2@1"]}) == {"pairs": "retrieval"}


def test_a_killed_publication_leaves_the_largest_as_it_was(
    store: MapStore, written: Written, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same build, started again, publishes all: the largest tells that the others are there."""
    publish(store, written("home"))
    before = in_use(store)

    def killed(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("mapping.pipeline.pieces.publish_tested", killed)
    with pytest.raises(KeyboardInterrupt):
        publish(store, written("home"), written("home-2"))
    assert in_use(store)["home"] == before["home"]
    monkeypatch.undo()
    again = written("home"), written("home-2")
    publish(store, *again)
    assert in_use(store) == {one.map_id: one.version for one in again}


def test_maps_of_others_are_passed_over(
    store: MapStore, written: Written, sample_map: Map, tmp_path: Path
) -> None:
    folder = tmp_path / "other"
    folder.mkdir()
    version = write_content(folder, content_of(sample_map), "home-2")
    store.publish(folder, "home-2", version)
    assert ids_of_pieces(store, "home", 3) == ["home", "home-3", "home-4"]
    publish(store, written("home"), written("home-3"))
    assert ids_of_pieces(store, "home", 3) == ["home", "home-3", "home-4"]
    publish(store, written("home"))
    assert in_use(store).keys() == {"home", "home-2"}
    assert in_use(store)["home-2"] == version


def test_a_map_merged_of_pieces_is_no_piece(
    store: MapStore, written: Written, sample_map: Map, tmp_path: Path
) -> None:
    """It has the notes of both, and its id may look like that of a piece."""
    publish(store, written("home"), written("home-2"))
    notes = store.open("home-2").manifest.notes
    folder = tmp_path / "merged"
    folder.mkdir()
    version = write_content(folder, replace(content_of(sample_map), notes=notes), "home-3")
    store.publish(folder, "home-3", version)
    publish(store, written("home"))
    assert in_use(store).keys() == {"home", "home-3"}
    assert ids_of_pieces(store, "home", 3) == ["home", "home-2", "home-4"]


def test_a_map_that_somebody_published_meanwhile_is_not_replaced(
    store: MapStore, written: Written, sample_map: Map, tmp_path: Path
) -> None:
    pieces = written("home"), written("home-2"), written("home-3")
    folder = tmp_path / "other"
    folder.mkdir()
    version = write_content(folder, content_of(sample_map), "home-3")
    store.publish(folder, "home-3", version)
    with pytest.raises(Conflict) as caught:
        publish(store, *pieces)
    assert caught.value.code == "map.exists"
    assert in_use(store) == {"home-3": version}
    assert store.versions("home-2") == []


def test_a_folder_without_versions_is_no_piece(store: MapStore, written: Written) -> None:
    """As a copy of a map leaves it that was interrupted, or somebody who deletes files by hand."""
    publish(store, written("home"))
    broken = store.root / "home-2"
    broken.mkdir()
    (broken / "current").write_text("20260101T000000.000Z-00000000\n")
    again = written("home"), written("home-2")
    publish(store, *again)
    assert in_use(store) == {one.map_id: one.version for one in again}


@pytest.mark.parametrize("map_id", ["a" * 61, "-home", ""])
def test_an_id_without_room_for_pieces_is_refused_before_the_long_work(map_id: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        refuse_long_id(map_id)
    assert caught.value.code == "map.id"


def test_the_longest_id_has_room_for_pieces() -> None:
    refuse_long_id("a" * 60)
