"""Builds whose dataset and work are in an S3 server, spoken to over a real socket."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import fsspec
import numpy as np
import pytest

from mapping.cluster.storage import is_remote, opened_dataset, place_of, storage_failed
from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from mapping.stages.work_folder import WorkFolder, key_of
from visloc.archive import Map, open_map
from visloc.errors import DatasetError, InvalidInput, Unavailable
from visloc.kapture import read_dataset


def quiet(_stage: str, _done: int, _total: int) -> None:
    pass


def settings_for(bucket: str, tmp_path: Path, **changes: object) -> BuildSettings:
    values: dict[str, object] = {
        "dataset": place_of(f"{bucket}/walk", "dataset"),
        "map_id": "walk",
        "maps_dir": tmp_path / "maps",
        "local_features": "sift",
        "global_features": ("localvlad",),
        "max_keypoints": 500,
        "cache_dir": tmp_path / "cache",
    }
    return BuildSettings(**(values | changes))  # type: ignore[arg-type]


def objects_of(bucket: str) -> set[str]:
    storage = fsspec.filesystem("s3", use_listings_cache=False)
    return {path.partition("/")[2] for path in storage.find(bucket)}


def test_a_build_that_was_interrupted_finds_its_work_at_the_url(
    bucket: str, tmp_path: Path, rgbd_walk: Map
) -> None:
    work = place_of(f"{bucket}/{tmp_path.name}/work", "--work-dir")
    settings = settings_for(bucket, tmp_path, method="rgbd", work_dir=work)

    def stop(stage: str, done: int, _total: int) -> None:
        if stage == "depth" and done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build_map(settings, stop)
    storage = fsspec.filesystem("s3", use_listings_cache=False)
    kept = storage.find(f"{bucket}/{tmp_path.name}/work", detail=True)
    assert sum("/lifted/" in name for name in kept) == 3
    written: dict[str, object] = {}

    def look(stage: str, done: int, _total: int) -> None:
        if stage == "archive" and done == 0:
            written.update(storage.find(f"{bucket}/{tmp_path.name}/work", detail=True))

    built = open_map(build_map(settings, look))
    assert {name: written[name]["LastModified"] for name in kept} == {  # type: ignore[index]
        name: info["LastModified"] for name, info in kept.items()
    }
    assert built.path.is_relative_to(tmp_path / "maps" / "walk")
    assert built.manifest.content_hash == rgbd_walk.manifest.content_hash


def test_a_dataset_of_a_url_is_that_of_the_folder(bucket: str, walk: Path) -> None:
    there = read_dataset(walk / "mapping")
    with opened_dataset(place_of(f"{bucket}/walk", "dataset")) as dataset:
        assert dataset.images == there.images
        assert dataset.depth_maps == there.depth_maps
        assert dataset.notes == there.notes
        record = dataset.images[3]
        assert dataset.has_file(record)
        assert dataset.path_of(record).read_bytes() == there.path_of(record).read_bytes()
        light = dataset.without_records()
        assert light.images == ()
        assert light.path_of(record) == dataset.path_of(record)


def test_photos_that_are_not_there_are_left_out(bucket: str, tmp_path: Path) -> None:
    storage = fsspec.filesystem("s3", use_listings_cache=False)
    place = f"{bucket}/{tmp_path.name}/some"
    storage.copy(f"{bucket}/walk/", f"{place}/", recursive=True)
    with opened_dataset(place_of(place, "dataset")) as dataset:
        storage.rm(str(dataset.path_of(dataset.images[0])))
    with opened_dataset(place_of(place, "dataset")) as dataset:
        assert not dataset.has_file(dataset.images[0])
        assert any("1 files do not exist" in note for note in dataset.notes), dataset.notes


def test_items_of_a_url_are_read_again_and_damaged_ones_made_again(
    bucket: str, tmp_path: Path
) -> None:
    place = place_of(f"{bucket}/{tmp_path.name}", "--work-dir")
    work, key = WorkFolder(place), key_of("stage", 1)
    with pytest.raises(Unavailable) as caught:
        work.read(key)
    assert (caught.value.code, caught.value.field) == (
        "build.missing_item",
        f"{bucket}/{tmp_path.name}/{key}.npz",
    )
    assert not work.has(key)
    work.get(key, lambda: {"a": np.arange(3)})
    assert work.has(key)
    assert work.read(key)["a"].tolist() == [0, 1, 2]
    (place / f"{key}.npz").write_bytes(b"PK torn")
    with pytest.raises(Unavailable, match="same command again to redo it"):
        work.read(key)
    assert not work.has(key)
    work.get(key, lambda: {"a": np.ones(1)})
    work.remove()
    assert not any(name.startswith(f"{tmp_path.name}/") for name in objects_of(bucket))
    work.remove()


def test_a_url_with_files_of_others_is_not_taken_for_finished_work(
    bucket: str, tmp_path: Path
) -> None:
    place = place_of(f"{bucket}/{tmp_path.name}/work", "--work-dir")
    (place / "photos" / "mine.jpg").write_bytes(b"mine")
    with pytest.raises(InvalidInput) as caught:
        WorkFolder(place).claim()
    assert caught.value.code == "build.work_dir"
    WorkFolder(place / "new").claim()
    WorkFolder(place / "new").claim()
    WorkFolder(place / "new").remove()
    found = {name for name in objects_of(bucket) if name.startswith(tmp_path.name)}
    assert found == {f"{tmp_path.name}/work/photos/mine.jpg"}


def test_a_build_removes_only_what_it_made(walk_copy: Path, tmp_path: Path) -> None:
    (walk_copy / "notes.txt").write_text("mine")
    before = sorted(walk_copy.rglob("*"))
    settings = BuildSettings(
        walk_copy,
        map_id=walk_copy.name,  # so that finished work might take the dataset's place
        maps_dir=tmp_path / "maps",
        local_features="sift",
        global_features=("localvlad",),
        max_keypoints=100,
        work_dir=walk_copy.parent,
    )
    work = walk_copy.parent / ".work" / walk_copy.name
    kept: list[Path] = []

    def watch(stage: str, done: int, _total: int) -> None:
        if (stage, done) == ("archive", 0):
            kept.extend(work.glob("lifted/*.npz"))

    built = build_map(settings, watch)
    assert len(kept) == 16
    assert not work.exists()
    assert sorted(walk_copy.rglob("*")) == before
    assert open_map(built).manifest.id == walk_copy.name


@pytest.mark.parametrize(
    ("work_dir", "maps_dir"),
    [
        ("maps", "maps"),
        ("maps/walk", "maps"),
        ("dataset", "maps"),
        ("dataset/sensors", "maps"),
        ("work", "work/.work/walk/maps"),
        ("s3://bucket/maps", "s3://bucket/maps"),
        ("s3://bucket", "s3://bucket/.work/walk/maps"),
    ],
)
def test_finished_work_is_not_kept_among_other_things(
    walk_copy: Path, tmp_path: Path, work_dir: str, maps_dir: str
) -> None:
    places = [
        place_of(text if "://" in text else str(tmp_path / text), "--work-dir")
        for text in (work_dir, maps_dir)
    ]
    settings = BuildSettings(walk_copy, "walk", places[1], work_dir=places[0])
    with pytest.raises(InvalidInput) as caught:
        build_map(settings, quiet)
    assert (caught.value.code, caught.value.field) == ("build.work_dir", "--work-dir")
    assert {path.name for path in tmp_path.iterdir()} == {"dataset"}


def test_folders_are_paths() -> None:
    assert place_of("some/folder", "dataset") == Path("some/folder")
    assert place_of("file:///some/folder", "dataset") == Path("/some/folder")
    assert not is_remote(place_of("/some", "dataset"))


@pytest.mark.parametrize(
    "url", ["nosuch://bucket/x", "s3://key:secret@bucket/x", "zip://a::s3://bucket/x"]
)
def test_a_url_that_cannot_be_used_is_refused(url: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        place_of(url, "--work-dir")
    assert (caught.value.code, caught.value.field) == ("build.url", "--work-dir")
    assert "secret" not in str(caught.value)


def test_maps_at_a_url_are_refused_without_the_extension(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("visloc.archive.store.extensions", lambda _group: {})
    settings = BuildSettings(tmp_path, "walk", place_of("s3://bucket/maps", "--maps-dir"))
    with pytest.raises(InvalidInput, match="need the extension object_storage") as caught:
        build_map(settings, quiet)
    assert (caught.value.code, caught.value.field) == ("build.url", "--maps-dir")


def test_a_url_without_a_dataset_is_refused(bucket: str, tmp_path: Path) -> None:
    settings = settings_for(bucket, tmp_path, dataset=place_of(f"{bucket}/nothing", "dataset"))
    with pytest.raises(DatasetError):
        build_map(settings, quiet)


def test_a_bucket_that_does_not_exist_is_an_error_with_its_name(
    bucket: str, tmp_path: Path
) -> None:
    work = place_of("s3://nosuchbucket/work", "--work-dir")
    settings = settings_for(bucket, tmp_path, work_dir=work, maps_dir=tmp_path)
    with pytest.raises(Unavailable) as caught:
        build_map(settings, quiet)
    assert caught.value.code == "storage.failed"
    assert "nosuchbucket" in str(caught.value)


@pytest.mark.parametrize(
    "changes", [{"method": "model"}, {"local_features": "kapture:sift"}], ids=["model", "features"]
)
def test_what_a_dataset_brings_along_is_not_read_from_a_url(
    bucket: str, tmp_path: Path, changes: dict[str, object]
) -> None:
    with pytest.raises(InvalidInput) as caught:
        build_map(settings_for(bucket, tmp_path, **changes), quiet)
    assert caught.value.code == "build.dataset"


@pytest.mark.parametrize(
    ("number", "resumes"),
    [(errno.ENOSPC, True), (errno.EIO, True), (errno.EACCES, False), (errno.ENOENT, False)],
)
def test_only_a_disk_that_was_full_or_away_lets_the_same_command_resume(
    tmp_path: Path, number: int, resumes: bool
) -> None:
    refused = storage_failed(OSError(number, os.strerror(number), "walk.mp4"), tmp_path)
    assert refused.field == "walk.mp4"
    assert os.strerror(number) in str(refused)
    assert ("the same command resumes" in str(refused)) == resumes
