from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController, threadpool_limits

import mapping.own_test.publishing
import mapping.pipeline.build
from mapping.cluster.workers import Workers
from mapping.methods.rgbd import DepthSettings
from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from mapping.stages.networks import Networks
from mapping.stages.work_folder import exclusive
from visloc.archive import Map, MapStore, verify_map, write_map
from visloc.errors import (
    Conflict,
    DatasetError,
    InvalidInput,
    Unavailable,
    VislocError,
    WeightsError,
)
from visloc.evaluation import pose_error
from visloc.features import make_local_features
from visloc.features.backends.choice import choose_inference
from visloc.features.local.sift import SiftExtractor
from visloc.geometry import Camera, Pose
from visloc.kapture import read_dataset
from visloc.localization.localizer import Localizer
from visloc.options import Inference, LocalizeOptions
from visloc.photos.reading import read_photo_file
from visloc.types import Localized

Damage = Callable[[Path], None]


class Query(Protocol):
    path: Path
    camera: Camera
    cam_from_world: Pose


FIRST_PHOTO = "mapping/left/0001.jpg"


def quiet(_stage: str, _done: int, _total: int) -> None:
    pass


def settings_for(dataset: Path, maps_dir: Path, **changes: object) -> BuildSettings:
    values: dict[str, object] = {"local_features": "sift", "force": True} | changes
    return BuildSettings(dataset, "room", maps_dir, **values)  # type: ignore[arg-type]


def build(dataset: Path, maps_dir: Path, **changes: object) -> Map:
    build_map(settings_for(dataset, maps_dir, **changes), quiet)
    return MapStore(maps_dir).open("room")


def items_of(maps_dir: Path) -> dict[Path, tuple[int, int]]:
    """Identity of every finished item of the unfinished build."""
    items = (maps_dir / ".work" / "room").glob("*/*.npz")
    return {path: ((info := path.stat()).st_ino, info.st_mtime_ns) for path in items}


def stage_of(item: Path) -> str:
    return item.parent.name


def data(dataset: Path, name: str = "") -> Path:
    return dataset / "sensors" / "records_data" / name


def edit(name: str, pattern: str, replacement: str, count: int = 0) -> Damage:
    """Change lines of one of the dataset's text files."""

    def change(dataset: Path) -> None:
        path = dataset / "sensors" / name
        text, changed = re.subn(
            pattern, replacement, path.read_text(), count=count, flags=re.MULTILINE
        )
        assert changed
        path.write_text(text)

    return change


def remove(name: str) -> Damage:
    return lambda dataset: (dataset / "sensors" / name).unlink()


def remove_photos(dataset: Path) -> None:
    for path in data(dataset).rglob("*.jpg"):
        path.unlink()


def truncate_photo(dataset: Path) -> None:
    path = data(dataset, FIRST_PHOTO)
    path.write_bytes(path.read_bytes()[:1000])


def shrink_photo(dataset: Path) -> None:
    cv2.imwrite(str(data(dataset, FIRST_PHOTO)), np.zeros((96, 128, 3), np.uint8))


def truncate_depth(dataset: Path) -> None:
    path = data(dataset, "mapping/left/0001.depth")
    path.write_bytes(path.read_bytes()[:-4])


def zero_depth(dataset: Path) -> None:
    for path in data(dataset).rglob("*.depth"):
        path.write_bytes(bytes(path.stat().st_size))


@pytest.fixture
def dataset(sample: Path, tmp_path: Path) -> Path:
    """A copy of the sample's mapping dataset that a test may damage."""
    return Path(shutil.copytree(sample / "mapping", tmp_path / "dataset"))


@pytest.mark.parametrize(
    ("damage", "kind", "code", "named"),
    [
        (remove("sensors.txt"), DatasetError, "kapture.no_dataset", "sensors/sensors.txt"),
        (
            edit("sensors.txt", r", 95\.\d*$", "", 1),
            DatasetError,
            "camera.param_count",
            r"sensors/sensors.txt:3",
        ),
        (
            edit("trajectories.txt", r"^(\d+, +rig, +)[^,]+", r"\1nan", 1),
            DatasetError,
            "kapture.number",
            r"sensors/trajectories.txt:3",
        ),
        (
            edit("records_camera.txt", r"\.jpg$", ".jpg, more", 1),
            DatasetError,
            "kapture.column_count",
            r"sensors/records_camera.txt:3",
        ),
        (
            edit("records_depth.txt", r"mapping/left", "../../mapping/left", 1),
            DatasetError,
            "kapture.path",
            r"sensors/records_depth.txt:3",
        ),
        (remove("records_camera.txt"), DatasetError, "dataset.no_photos", "records_camera.txt"),
        (remove_photos, DatasetError, "dataset.no_photos", "8 of 8 photos .* file is absent"),
        (remove("trajectories.txt"), DatasetError, "dataset.no_photos", "8 of 8 .* have no pose"),
        (truncate_photo, InvalidInput, "image.undecodable", FIRST_PHOTO),
        (shrink_photo, DatasetError, "dataset.photo_size", FIRST_PHOTO),
        (truncate_depth, DatasetError, "depth.size", "mapping/left/0001.depth"),
        (remove("records_depth.txt"), DatasetError, "dataset.no_depth", "records_depth.txt"),
        (zero_depth, InvalidInput, "rgbd.no_landmarks", "--depth-sensor"),
    ],
)
def test_a_bad_dataset_is_refused_by_name_and_the_map_before_still_serves(
    dataset: Path, maps_dir: Path, damage: Damage, kind: type[VislocError], code: str, named: str
) -> None:
    before = MapStore(maps_dir).open("room")
    damage(dataset)
    with pytest.raises(kind, match=named) as caught:
        build(dataset, maps_dir)
    assert caught.value.code == code
    after = MapStore(maps_dir).open("room")
    assert after.manifest == before.manifest


@pytest.mark.parametrize(
    ("changes", "kind", "code", "named"),
    [
        ({"local_features": "surf"}, InvalidInput, "features.unknown", "faster2d2.*got surf"),
        ({"global_features": ("gist",)}, InvalidInput, "features.unknown", "densevlad.*got gist"),
        (
            {"global_features": ("localvlad", "localvlad")},
            InvalidInput,
            "build.global_features",
            "each once.*got localvlad,localvlad",
        ),
        ({"method": "nerf"}, InvalidInput, "build.method", "--method.*rgbd.*got nerf"),
        (
            {"depth": DepthSettings(voxel_size=0.0)},
            InvalidInput,
            "build.voxel_size",
            "--voxel-size",
        ),
        (
            {"depth": DepthSettings(voxel_size=float("nan"))},
            InvalidInput,
            "build.voxel_size",
            "--voxel-size",
        ),
        (
            {"depth": DepthSettings(depth_scale=float("inf"))},
            InvalidInput,
            "build.depth_scale",
            "--depth-scale",
        ),
        ({"depth_sensor": "lidar"}, DatasetError, "depth.sensor", "left_depth.*got lidar"),
        ({"force": False}, Conflict, "map.exists", "'room' exists.*--force"),
    ],
)
def test_a_wrong_setting_is_refused_and_the_map_before_still_serves(
    sample: Path,
    maps_dir: Path,
    changes: dict[str, object],
    kind: type[VislocError],
    code: str,
    named: str,
) -> None:
    before = MapStore(maps_dir).open("room")
    with pytest.raises(kind, match=named) as caught:
        build(sample / "mapping", maps_dir, **changes)
    assert caught.value.code == code
    assert MapStore(maps_dir).open("room").manifest == before.manifest


def test_an_id_that_leads_out_of_the_folder_of_maps_is_refused(
    sample: Path, tmp_path: Path
) -> None:
    with pytest.raises(InvalidInput, match=r"got \.\./room") as caught:
        build_map(BuildSettings(sample / "mapping", "../room", tmp_path / "maps"), quiet)
    assert caught.value.code == "map.id"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("weights_dir", [None, Path("no_such_folder")])
def test_missing_weights_say_what_to_download_from_where_under_which_licence(
    sample: Path, maps_dir: Path, weights_dir: Path | None
) -> None:
    before = MapStore(maps_dir).open("room")
    with pytest.raises(WeightsError) as caught:
        build(sample / "mapping", maps_dir, local_features="r2d2", weights_dir=weights_dir)
    assert caught.value.code == "weights.missing"
    text = str(caught.value)
    for said in (
        *("r2d2_WASF_N16.pt", "github.com/naver/r2d2", "CC BY-NC-SA", "non-commercial"),
        *("--weights-dir", "VISLOC_WEIGHTS_DIR", str(weights_dir or "no weights folder")),
    ):
        assert said in text
    assert MapStore(maps_dir).open("room").manifest == before.manifest


def test_photos_without_file_or_pose_are_left_out_and_told(dataset: Path, tmp_path: Path) -> None:
    data(dataset, FIRST_PHOTO).unlink()
    # The second instant has no pose, so neither of its two photos has.
    edit("trajectories.txt", r"^\d+1000, .*\n", "", 1)(dataset)
    built = build(dataset, tmp_path / "maps")
    assert built.manifest.counts.images == 5
    assert FIRST_PHOTO not in [image.name for image in built.images]
    notes = "\n".join(built.manifest.notes)
    assert f"1 of 8 photos are listed, but the file is absent: {FIRST_PHOTO}" in notes
    assert "2 of 8 photos have no pose: mapping/left/0002.jpg, mapping/right/0002.jpg" in notes
    assert "sensors/records_camera.txt: 1 files do not exist (first in line" in notes


def test_a_photo_without_depth_is_there_for_retrieval_only(dataset: Path, tmp_path: Path) -> None:
    # Without the left camera's depth map it would be that of the right one, which sees the same.
    data(dataset, "mapping/left/0001.depth").unlink()
    data(dataset, "mapping/right/0001.depth").unlink()
    built = build(dataset, tmp_path / "maps")
    without = np.array(["0001" in image.name for image in built.images])
    observations = np.diff(built.observation_offsets)
    assert (observations[without] == 0).all()
    assert (observations[~without] > 100).all()
    assert built.global_descriptors["densevlad"][without].any(axis=1).all()
    assert (
        f"2 of 8 photos have no depth map: retrieval only: {FIRST_PHOTO}, mapping/right/0001.jpg"
        in built.manifest.notes
    )


def errors_of_queries(built: Map, queries: list[Query]) -> NDArray[np.float64]:
    """(n, 2): metres and degrees; every query must be localized."""
    localizer = Localizer(built, make_local_features("sift"))
    errors = []
    for query in queries:
        answer = localizer.localize(read_photo_file(query.path), query.camera, LocalizeOptions())
        assert isinstance(answer, Localized)
        errors.append(pose_error(answer.cam_from_world, query.cam_from_world))
    return np.array(errors)


def test_depth_in_16_bit_png_gives_nearly_the_same_map(
    dataset: Path, tmp_path: Path, built_maps: Path, queries: list[Query]
) -> None:
    for record in read_dataset(dataset).depth_maps:
        path = data(dataset, record.path)
        millimetres = np.fromfile(path, "<f4").reshape(192, 256) * 1000
        path.write_bytes(cv2.imencode(".png", np.rint(millimetres).astype(np.uint16))[1].tobytes())
    raw, png = MapStore(built_maps).open("room"), build(dataset, tmp_path / "maps")
    assert png.manifest.counts.observations == pytest.approx(
        raw.manifest.counts.observations, rel=0.01
    )
    # Every landmark lies within half a millimetre of depth, at most 0.8 mm along an oblique ray,
    # of where it was; a few moved to another voxel.
    distance = nearest_distances(png.landmarks, raw.landmarks)
    assert np.quantile(distance, 0.9) < 0.001
    errors = errors_of_queries(png, queries)
    assert errors.max(axis=0) == pytest.approx([0.0, 0.0], abs=0.1)
    assert errors[:, 0].max() < 0.003


def nearest_distances(
    points: NDArray[np.float32], others: NDArray[np.float32]
) -> NDArray[np.float64]:
    from scipy.spatial import KDTree

    return np.asarray(KDTree(others).query(points)[0])


def test_depth_of_another_camera_is_registered_to_the_photos(
    dataset: Path, tmp_path: Path, queries: list[Query]
) -> None:
    # Only the right camera's depth is left, so that the left photos see it from 12 cm beside and
    # with another focal length.
    edit("records_depth.txt", r"^.*left_depth.*\n", "")(dataset)
    built = build(dataset, tmp_path / "maps")
    lefts = np.array(["left" in image.name for image in built.images])
    assert (np.diff(built.observation_offsets)[lefts] > 100).all()
    errors = errors_of_queries(built, queries)
    assert errors[:, 0].max() < 0.01
    assert errors[:, 1].max() < 0.1


def test_equal_builds_have_equal_content_hashes_and_versions_of_their_own(
    sample: Path, built_maps: Path, tmp_path: Path
) -> None:
    first, second = MapStore(built_maps).open("room"), build(sample / "mapping", tmp_path)
    assert first.manifest.content_hash == second.manifest.content_hash
    third = build(sample / "mapping", tmp_path, depth=DepthSettings(voxel_size=0.02))
    assert third.manifest.content_hash != second.manifest.content_hash
    published = {second.manifest.version, third.manifest.version}
    assert set(MapStore(tmp_path).versions("room")) == published
    assert not (tmp_path / ".work" / "room").exists()


class Stopped(Exception):
    pass


def stop_before_archive(stage: str, _done: int, _total: int) -> None:
    if stage == "archive":
        raise Stopped


def test_a_changed_setting_finds_again_what_does_not_depend_on_it(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def work(**changes: object) -> dict[Path, tuple[int, int]]:
        with pytest.raises(Stopped):
            build_map(settings_for(dataset, tmp_path, **changes), stop_before_archive)
        return items_of(tmp_path)

    first = work()
    assert {stage_of(item) for item in first} == {
        *("local_features", "words", "vocabulary", "pooled", "projection", "lifted"),
    }
    assert (
        work(depth=DepthSettings(voxel_size=0.02)) == first
    )  # it concerns nothing but the last step

    data(dataset, FIRST_PHOTO).write_bytes(data(dataset, FIRST_PHOTO).read_bytes() + b"\0")
    changed = work()
    assert changed.items() >= first.items()
    new = [stage_of(item) for item in changed.keys() - first.keys()]
    assert new.count("local_features") == new.count("lifted") == 1

    fewer = work(max_keypoints=200)
    new = [stage_of(item) for item in fewer.keys() - changed.keys()]
    assert new.count("local_features") == new.count("lifted") == 8

    monkeypatch.setattr(SiftExtractor, "computed_with", "another OpenCV")
    elsewhere = work(max_keypoints=200)
    new = [stage_of(item) for item in elsewhere.keys() - fewer.keys()]
    assert new.count("local_features") == new.count("lifted") == 8


def test_photos_with_the_camera_of_another_size_are_refused_on_resumption_too(
    dataset: Path, tmp_path: Path
) -> None:
    with pytest.raises(Stopped):
        build_map(settings_for(dataset, tmp_path), stop_before_archive)
    edit("sensors.txt", "256, 192, ", "192, 256, ")(dataset)
    with pytest.raises(DatasetError, match=f"{FIRST_PHOTO}.*192 x 256.*got 256 x 192"):
        build(dataset, tmp_path)


def test_a_second_build_of_the_same_map_is_refused(sample: Path, maps_dir: Path) -> None:
    with (
        exclusive(maps_dir / ".work" / "room.lock"),
        pytest.raises(Conflict, match=r"\.work/room\.lock.*another build") as caught,
    ):
        build(sample / "mapping", maps_dir)
    assert caught.value.code == "build.running"


def test_one_thread_computes_however_many_processors_there_are(
    sample: Path, tmp_path: Path
) -> None:
    threads = set()

    def look(stage: str, _done: int, _total: int) -> None:
        if stage in ("localvlad", "archive"):
            threads.update(pool["num_threads"] for pool in blas.info())

    blas = ThreadpoolController().select(user_api="blas")
    with threadpool_limits(2, user_api="blas"):
        build_map(settings_for(sample / "mapping", tmp_path, max_keypoints=50), look)
        assert {pool["num_threads"] for pool in blas.info()} == {2}
    assert threads == {1}


def test_a_build_on_a_cluster_computes_as_suits_the_machine_that_begins_it(
    sample: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Inference] = []

    def note_source(*_: object, networks: Networks, **__: object) -> None:
        asked.append(networks.inference)
        raise Stopped

    monkeypatch.setattr(mapping.pipeline.checks, "executor_names", lambda: ["local", "cluster"])
    monkeypatch.setattr(mapping.pipeline.build, "open_executor", lambda *_: Workers(1))
    monkeypatch.setattr(mapping.pipeline.build, "local_features_source", note_source)
    for executor in ("local", "cluster"):
        with pytest.raises(Stopped):
            build_map(settings_for(sample / "mapping", tmp_path, executor=executor), quiet)
    assert asked == [Inference.AUTO, choose_inference(Inference.AUTO)]


def test_a_full_disk_is_named_and_the_same_build_resumes(
    sample: Path, maps_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def write_on_full_disk(folder: Path, *args: Any, **kwargs: Any) -> str:
        (folder / "observation_descriptors.npy").symlink_to("/dev/full")
        return write_map(folder, *args, **kwargs)

    before = MapStore(maps_dir).open("room")
    with monkeypatch.context() as full:
        full.setattr(mapping.own_test.publishing, "write_map", write_on_full_disk)
        with pytest.raises(Unavailable, match=r"No space left on device.*resumes") as caught:
            build(sample / "mapping", maps_dir)
    assert caught.value.code == "storage.failed"
    assert str(maps_dir) in str(caught.value)
    assert MapStore(maps_dir).open("room").manifest == before.manifest
    work = maps_dir / ".work" / "room"
    assert not (work / "incoming").exists()

    items = items_of(maps_dir)
    assert items
    with pytest.raises(Stopped):
        build_map(settings_for(sample / "mapping", maps_dir), stop_before_archive)
    assert items_of(maps_dir) == items
    assert build(sample / "mapping", maps_dir).manifest.version != before.manifest.version
    assert not work.exists()


# Runs the command with trouble ahead: "progress:STAGE:DONE" and "call:MODULE:FUNCTION" kill it
# there, "limit:BYTES" keeps files from growing.
RUN = """
import importlib, os, resource, signal, sys
from mapping.cli import main as cli
from mapping.cli import progress

def die(*_, **__):
    os.kill(os.getpid(), signal.SIGKILL)

kind, *where = sys.argv.pop(1).split(":")
if kind == "progress":
    show = progress.StageProgress.__call__
    def show_and_die(self, stage, done, total):
        show(self, stage, done, total)
        if [stage, str(done)] == where:
            die()
    progress.StageProgress.__call__ = show_and_die
elif kind == "call":
    setattr(importlib.import_module(where[0]), where[1], die)
elif kind == "limit":
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(where[0]),) * 2)
cli.main()
"""


def run_build(dataset: Path, maps_dir: Path, trouble: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [
            *(sys.executable, "-c", RUN, trouble, "build", str(dataset), "--map=room"),
            *(f"--maps-dir={maps_dir}", "--local-features=sift", "--max-keypoints=400", "--force"),
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env={name: value for name, value in os.environ.items() if "VISLOC" not in name},
    )


@pytest.mark.slow
def test_killed_in_any_stage_the_same_command_resumes_and_makes_the_same_map(
    sample: Path, maps_dir: Path, tmp_path: Path
) -> None:
    store = MapStore(maps_dir)
    before = store.open("room").manifest
    undisturbed = build(sample / "mapping", tmp_path / "undisturbed", max_keypoints=400)

    items = items_of(maps_dir)
    for trouble in (
        "progress:photos:4",
        "progress:local features:3",
        "progress:densevlad words:5",
        "call:visloc.features.descriptors.vlad:learn_words",
        "progress:densevlad:2",
        "call:visloc.features.descriptors.whitening:learn_whitening",
        "progress:localvlad:1",
        "progress:depth:4",
        "call:mapping.methods.rgbd:merge_landmarks",
        "call:visloc.archive.files:manifest_hash",  # all arrays are written, no manifest
        "call:visloc.archive.backends.folder:_sync_folder",  # the version is there, not current
    ):
        killed = run_build(sample / "mapping", maps_dir, trouble)
        assert killed.returncode == -signal.SIGKILL, (trouble, killed.stderr)
        found = items_of(maps_dir)
        assert found.items() >= items.items(), trouble  # nothing finished was done again
        items = found
        assert store.open("room").manifest == before
        verify_map(store.folder("room"))
    assert {stage_of(item) for item in items} == {
        *("local_features", "words", "vocabulary", "pooled", "projection", "lifted"),
    }

    finished = run_build(sample / "mapping", maps_dir, "none")
    assert finished.returncode == 0, finished.stderr
    after = verify_map(store.folder("room")).manifest
    assert after.version != before.version
    assert after.content_hash == undisturbed.manifest.content_hash
    assert not (maps_dir / ".work" / "room").exists()
    assert store.open(f"room@{before.version}").manifest == before


def test_a_first_build_killed_while_it_publishes_needs_no_force(
    sample: Path, tmp_path: Path
) -> None:
    built = build(sample / "mapping", tmp_path)
    (tmp_path / "room" / "current").unlink()
    settings = settings_for(
        sample / "mapping", tmp_path, depth=DepthSettings(voxel_size=0.02), force=False
    )
    assert build_map(settings, quiet).name == MapStore(tmp_path).current_version("room")
    assert built.manifest.version in MapStore(tmp_path).versions("room")


@pytest.mark.slow
def test_a_file_that_cannot_be_written_whole_ends_the_command_with_one_line(
    sample: Path, maps_dir: Path
) -> None:
    before = MapStore(maps_dir).open("room").manifest
    failed = run_build(sample / "mapping", maps_dir, "limit:65536")
    assert failed.returncode == 1
    *stages, error = failed.stderr.splitlines()
    assert all(re.fullmatch(r"[a-z ]+: \d+/\d+ in .* s", line) for line in stages)
    assert error.startswith(f"error [storage.failed] {maps_dir / '.work' / 'room'}: ")
    assert "File too large" in error
    assert MapStore(maps_dir).open("room").manifest == before


@pytest.mark.slow
def test_with_workers_the_main_process_loads_no_torch(sample: Path, tmp_path: Path) -> None:
    """It costs the main process two seconds and a quarter of a gigabyte."""
    program = (
        "import sys; from pathlib import Path; from mapping.pipeline.build import build_map;"
        "from mapping.pipeline.settings import BuildSettings;"
        "from mapping.progress import nothing_told;"
        "settings = BuildSettings(Path(sys.argv[1]), 'room', Path(sys.argv[2]), workers=2);"
        "build_map(settings, nothing_told); print('torch' in sys.modules)"
    )
    words = [sys.executable, "-c", program, str(sample / "mapping"), str(tmp_path / "maps")]
    assert subprocess.run(words, check=True, capture_output=True, text=True).stdout == "False\n"
