"""A capture joins a map of the sample: the room is known, and so are all poses."""

from __future__ import annotations

import re
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from mapping.cli import main as cli
from mapping.cluster.workers import DEFAULT_WORKERS
from mapping.maps.editing import content_of
from mapping.own_test.publishing import publish_edited
from mapping.own_test.trials import own_test
from mapping.sample import write_sample
from tests.mapping.cli.test_from_settings import settings_of
from visloc.archive import Map, MapStore, open_map, verify_map
from visloc.errors import Conflict, VislocError
from visloc.evaluation import pose_error
from visloc.geometry import Pose, Similarity
from visloc.kapture import Dataset, read_dataset, write_dataset
from visloc_extensions.living_maps.updating import UpdateSettings, update_map
from visloc_extensions.living_maps.updating.job import Updated
from visloc_extensions.living_maps.updating.placing import beside

TURN = Pose.from_quaternion([0.8, 0.1, -0.5, 0.3], [0, 0, 0]).rotation
# Where the second capture has its own frame.
ELSEWHERE = Similarity(1.0, TURN, np.array([3.0, -40.0, 7.0]))


def moved_dataset(dataset: Dataset, here_from_world: Similarity, root: Path) -> Dataset:
    """The same photos, with poses and rigs in another frame and unit."""
    scale = here_from_world.scale
    return replace(
        dataset,
        root=root,
        trajectories={key: here_from_world.move(p) for key, p in dataset.trajectories.items()},
        rigs={
            rig: {s: p and Pose(p.rotation, scale * p.translation) for s, p in members.items()}
            for rig, members in dataset.rigs.items()
        },
    )


def write_capture(walk: Path, root: Path, here_from_world: Similarity, *, odd: bool) -> Path:
    """Every second instant of the walk, in a frame of its own."""
    dataset = moved_dataset(read_dataset(walk / "mapping"), here_from_world, root)
    images = [i for i in dataset.images if (i.timestamp // 1000 % 2 == 1) == odd]
    (root / "sensors").mkdir(parents=True)
    (root / "sensors" / "records_data").symlink_to(walk / "mapping" / "sensors" / "records_data")
    write_dataset(replace(dataset, images=tuple(images)))
    return root


@pytest.fixture(scope="module")
def captures(walk: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``first`` in the frame of the walk, ``second`` and ``scaled`` in others."""
    folder = tmp_path_factory.mktemp("captures")
    write_capture(walk, folder / "first", Similarity.identity(), odd=False)
    write_capture(walk, folder / "second", ELSEWHERE, odd=True)
    write_capture(walk, folder / "scaled", replace(ELSEWHERE, scale=3.0), odd=True)
    write_capture(walk, folder / "in_frame", Similarity.identity(), odd=True)
    return folder


@pytest.fixture(scope="module")
def first_maps(
    captures: Path, tmp_path_factory: pytest.TempPathFactory, build_walk: Callable[..., Map]
) -> Path:
    """A folder of maps with ``walk``, by depth from the first capture; only to be read."""
    maps = tmp_path_factory.mktemp("first")
    build_walk(captures / "first", maps, method="rgbd", keep_photos=True, keep_colours=True)
    return maps


@pytest.fixture
def maps_dir(first_maps: Path, tmp_path: Path) -> Path:
    """A copy of the maps that a test may change."""
    return Path(shutil.copytree(first_maps, tmp_path / "maps"))


def quiet(_stage: str, _done: int, _total: int) -> None:
    pass


def update(dataset: Path, maps_dir: Path, **changes: object) -> Updated:
    values: dict[str, object] = {"map_ref": "walk"} | changes
    return update_map(UpdateSettings(dataset=dataset, maps_dir=maps_dir, **values), quiet)  # type: ignore[arg-type]


def errors_of_poses(opened: Map, walk: Path, first: int = 0) -> NDArray[np.float64]:
    """(n, 2): how far photos of the map, from one on, are from where they were taken."""
    dataset = read_dataset(walk / "mapping")
    truth = {image.path: dataset.pose(image) for image in dataset.images}
    errors = []
    for image, row in list(zip(opened.images, opened.image_poses, strict=True))[first:]:
        pose = truth[image.name.removeprefix("again/")]
        assert pose is not None
        errors.append(pose_error(Pose.from_quaternion(row[:4], row[4:]), pose))
    return np.array(errors)


def refused(dataset: Path, maps_dir: Path, **changes: object) -> VislocError:
    """Why an update is refused; nothing may have changed."""
    before = MapStore(maps_dir).versions("walk")
    with pytest.raises(VislocError) as caught:
        update(dataset, maps_dir, **changes)
    assert MapStore(maps_dir).versions("walk") == before
    return caught.value


@pytest.fixture(scope="module")
def updated(
    captures: Path, first_maps: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Map, Updated]:
    """The first map with the second capture tied to it; only to be read."""
    maps = tmp_path_factory.mktemp("updated") / "maps"
    shutil.copytree(first_maps, maps)
    done = update(captures / "second", maps)
    return verify_map(done.folder), done


def test_an_updated_map_is_tested_anew(updated: tuple[Map, Updated]) -> None:
    opened, _ = updated
    learned = opened.manifest.parts.own_test
    assert learned == own_test(opened)
    assert learned.localized > 0


def test_a_capture_in_a_frame_of_its_own_is_tied_to_within_centimetres(
    updated: tuple[Map, Updated], walk: Path
) -> None:
    opened, done = updated
    assert len(opened.images) == 16
    errors = errors_of_poses(opened, walk, 8)
    assert errors[:, 0].max() < 0.01
    assert errors[:, 1].max() < 0.1
    assert done.record.tied == done.record.tried == done.record.localized == 8
    assert done.record.photos == 8
    assert done.record.scale == 1.0
    assert done.record.pixels < 1.0
    (kept,) = opened.manifest.method.settings["updates"]  # type: ignore[misc,union-attr]
    assert kept["capture"] == "second"  # type: ignore[index,call-overload]
    assert kept["tied"] == 8  # type: ignore[index,call-overload]


def test_what_the_map_had_stays_row_by_row_as_it_was(
    updated: tuple[Map, Updated], first_maps: Path
) -> None:
    new, old = updated[0], MapStore(first_maps).open("walk")
    assert new.images[: len(old.images)] == old.images
    for name in (
        *("image_poses", "landmarks", "errors_px", "angles_deg", "colors", "observation_landmarks"),
        *("observation_descriptors", "observation_keypoints"),
    ):
        before = getattr(old, name)
        assert_array_equal(getattr(new, name)[: len(before)], before, err_msg=name)
    assert_array_equal(new.observation_offsets[:9], old.observation_offsets)
    assert new.manifest.local_features == old.manifest.local_features
    for name, rows in old.global_descriptors.items():
        grown = new.global_descriptors[name]
        assert_array_equal(grown.values[:8], rows.values)
        assert_array_equal(grown.scales[:8], rows.scales)  # type: ignore[index]
        for part, array in old.global_models[name].items():
            assert_array_equal(new.global_models[name][part], array)
    for row in range(8):
        assert new.photo(row) == old.photo(row)
    assert new.photo(15) is not None


def test_observations_join_old_landmarks_in_their_voxel_and_others_are_new(
    updated: tuple[Map, Updated], first_maps: Path
) -> None:
    new, old = updated[0], MapStore(first_maps).open("walk")
    count, first = len(old.landmarks), int(old.observation_offsets[-1])
    joined = np.asarray(new.observation_landmarks[first:])
    again = np.bincount(joined[joined < count], minlength=count)
    assert 0 < (joined < count).sum() < len(joined)
    assert_array_equal(new.track_lengths[:count], old.track_lengths + again)
    assert_array_equal(
        new.track_lengths, np.bincount(new.observation_landmarks, minlength=len(new.landmarks))
    )
    # A voxel has a landmark of either, not of both.
    cells = np.floor(new.landmarks.astype(np.float64) / 0.01).astype(np.int64)
    cells_of_old = {tuple(cell) for cell in cells[:count].tolist()}
    shared = [tuple(cell) in cells_of_old for cell in cells[count:].tolist()]
    assert np.mean(shared) < 0.001  # but for those whose mean was rounded across the edge


def test_the_updated_map_localizes_better_than_centimetres(
    updated: tuple[Map, Updated],
    walk: Path,
    localization_errors: Callable[[Map, Path], NDArray[np.float64]],
) -> None:
    errors = localization_errors(updated[0], walk / "query")
    assert np.median(errors[:, 0]) < 0.01


@pytest.fixture(scope="module")
def other_room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four photos of a room of the same shape and quite other pictures."""
    folder = tmp_path_factory.mktemp("other") / "room"
    write_sample(folder, images=4, seed=1, size=(256, 192))
    return folder / "mapping"


@pytest.mark.parametrize("poses", ["tie", "given", "localize"])
def test_photos_of_another_room_are_refused(poses: str, maps_dir: Path, other_room: Path) -> None:
    # Its photos are called as those of the map.
    error = refused(other_room, maps_dir, poses=poses, capture="other")
    assert error.code == "update.elsewhere"
    assert "expected half of 4 photos" in str(error)


def test_another_place_is_told_from_a_capture_of_this_one_that_lacks_depth(
    captures: Path, maps_dir: Path, other_room: Path, tmp_path: Path
) -> None:
    for dataset, code in ((other_room, "update.elsewhere"), (captures / "second", "no_depth")):
        bare = tmp_path / code
        shutil.copytree(
            dataset, bare, symlinks=True, ignore=shutil.ignore_patterns("records_depth.txt")
        )
        assert code in refused(bare, maps_dir, capture="other").code


def test_poses_that_are_said_to_be_in_the_maps_frame_are_taken_as_they_are(
    captures: Path, maps_dir: Path, walk: Path
) -> None:
    done = update(captures / "in_frame", maps_dir, poses="given")
    errors = errors_of_poses(open_map(done.folder), walk)
    assert errors[:, 0].max() < 1e-9
    assert done.record.tied == 8


def test_poses_that_are_not_in_the_maps_frame_are_refused(captures: Path, maps_dir: Path) -> None:
    error = refused(captures / "second", maps_dir, poses="given")
    assert error.code == "update.elsewhere"
    assert "--poses" in str(error)


def test_poses_of_another_convention_are_refused_with_its_name(
    captures: Path, maps_dir: Path, tmp_path: Path
) -> None:
    dataset, written = read_dataset(captures / "in_frame"), tmp_path / "written"
    poses = {key: pose.inverse() for key, pose in dataset.trajectories.items()}
    ignored = shutil.ignore_patterns("*.txt")
    shutil.copytree(captures / "in_frame", written, symlinks=True, ignore=ignored)
    write_dataset(replace(dataset, root=written, trajectories=poses))
    error = refused(written, maps_dir, poses="given")
    assert "They look like camera-to-world poses" in str(error)


def test_a_trajectory_that_is_no_similarity_away_is_refused(
    captures: Path, maps_dir: Path, tmp_path: Path
) -> None:
    dataset = read_dataset(captures / "second")
    random, shaken = np.random.default_rng(0), tmp_path / "shaken"
    poses = {
        key: Pose(pose.rotation, pose.translation + random.uniform(-3, 3, 3))
        for key, pose in dataset.trajectories.items()
    }
    shutil.copytree(
        captures / "second", shaken, symlinks=True, ignore=shutil.ignore_patterns("*.txt")
    )
    write_dataset(replace(dataset, root=shaken, trajectories=poses))
    assert refused(shaken, maps_dir).code == "update.elsewhere"


def write_drifted(source: Path, root: Path, num_instants: int) -> Path:
    """A capture whose first instants are a metre from where they were."""
    dataset = read_dataset(source)
    shutil.copytree(source, root, symlinks=True, ignore=shutil.ignore_patterns("*.txt"))
    wrong = sorted({image.timestamp for image in dataset.images})[:num_instants]
    poses = {
        (time, device): Pose(pose.rotation, pose.translation + np.array([time in wrong, 0, 0]))
        for (time, device), pose in dataset.trajectories.items()
    }
    write_dataset(replace(dataset, root=root, trajectories=poses))
    return root


@pytest.mark.parametrize(("poses", "name"), [("tie", "second"), ("given", "in_frame")])
def test_photos_that_the_map_contradicts_are_left_out(
    poses: str, name: str, captures: Path, maps_dir: Path, tmp_path: Path, walk: Path
) -> None:
    half = write_drifted(captures / name, tmp_path / "half", 2)
    assert refused(half, maps_dir, poses=poses).code == "update.elsewhere"

    drifted = write_drifted(captures / name, tmp_path / "drifted", 1)
    done = update(drifted, maps_dir, poses=poses)
    opened = open_map(done.folder)
    assert errors_of_poses(opened, walk, 8)[:, 0].max() < 0.01
    assert done.record.tied == done.record.photos == 6
    (note,) = done.notes
    assert re.fullmatch(
        r"drifted: 2 of 8 photos left out, since the map localizes them (1|1\.0\d|0\.99\d) m, "
        r"0\.\d+ degrees from their own poses, in the median: "
        r"mapping/left/0002\.jpg, mapping/right/0002\.jpg",
        note,
    ), note
    assert note in opened.manifest.notes


def test_photos_beside_contradicted_ones_are_tried_too(
    captures: Path, maps_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, walk: Path
) -> None:
    # Of eight, rows 0, 2, 5 and 7 are tried first; the last two, of one instant, lie elsewhere.
    monkeypatch.setattr("visloc_extensions.living_maps.updating.job._TIED_BY", 4)
    dataset, drifted = read_dataset(captures / "second"), tmp_path / "drifted"
    shutil.copytree(captures / "second", drifted, symlinks=True)
    for path in (drifted / "sensors").glob("*.txt"):
        path.unlink()
    last = max(image.timestamp for image in dataset.images)
    poses = {
        key: Pose(pose.rotation, pose.translation + np.array([key[0] == last, 0, 0]))
        for key, pose in dataset.trajectories.items()
    }
    write_dataset(replace(dataset, root=drifted, trajectories=poses))
    done = update(drifted, maps_dir)
    assert errors_of_poses(open_map(done.folder), walk, 8)[:, 0].max() < 0.02
    assert (done.record.tried, done.record.tied, done.record.photos) == (4, 3, 6)


def test_whom_a_contradicted_photo_makes_doubtful() -> None:
    # 2 and 3 have a wrong neighbour, 7 none; 8 and 9 have one on their only side.
    assert beside({1}, {0, 1, 4, 6}, 8) == [2, 3]
    assert beside({7}, {0, 7}, 10) == [1, 2, 3, 4, 5, 6, 8, 9]
    assert beside(set(), {0, 7}, 10) == []


def test_depth_in_metres_does_not_join_poses_of_another_unit(
    captures: Path, maps_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    error = refused(captures / "scaled", maps_dir, metric=False)
    assert error.code == "update.elsewhere"
    assert "by depth, what they see is" in error.message

    monkeypatch.setattr("visloc_extensions.living_maps.updating.placing._MIN_LIFTED", 10**9)
    error = refused(captures / "scaled", maps_dir, metric=False)
    assert "do not tell whether its unit" in error.message


def test_rigs_of_another_unit_than_the_map_do_not_join_with_localized_photos(
    captures: Path, tmp_path: Path, build_walk: Callable[..., Map]
) -> None:
    before = build_walk(captures / "scaled", tmp_path, metric=False)
    done = update(captures / "first", tmp_path, poses="localize")
    opened = open_map(done.folder)
    assert len(opened.images) == 16
    assert content_of(opened).rigs == content_of(before).rigs


def test_a_single_photo_has_nothing_to_be_matched_with(
    captures: Path, maps_dir: Path, tmp_path: Path
) -> None:
    dataset = read_dataset(captures / "second")
    root = Path(shutil.copytree(captures / "second", tmp_path / "single", symlinks=True))
    for path in (root / "sensors").glob("*.txt"):
        path.unlink()
    write_dataset(replace(dataset, root=root, images=dataset.images[:1]))
    error = refused(root, maps_dir, poses="localize", method="sfm")
    assert error.code == "update.photos_few"
    assert "--method rgbd" in str(error.expected)


@pytest.mark.parametrize("changes", [{"updates": {}}, {"voxel_size": 0}, {"voxel_size": True}])
def test_strange_settings_of_the_map_are_refused_before_the_work(
    changes: dict[str, object], captures: Path, maps_dir: Path
) -> None:
    store = MapStore(maps_dir)
    content = content_of(store.open("walk"))
    publish_edited(store, replace(content, settings={**content.settings, **changes}), "strange")
    told: list[str] = []
    with pytest.raises(Conflict) as caught:
        update_map(
            UpdateSettings("strange", captures / "second", maps_dir),
            lambda stage, _done, _total: told.append(stage),
        )
    assert caught.value.code == "update.settings"
    assert told == []


@pytest.mark.parametrize(
    ("poses", "dataset", "factor", "enough"),
    [
        ("tie", "second", 1.05, 100),
        ("tie", "second", 5.0, 10**9),
        ("given", "in_frame", 5.0, 100),
        ("localize", "second", 5.0, 100),
    ],
)
def test_depth_of_another_unit_than_the_poses_is_refused(
    captures: Path,
    maps_dir: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    poses: str,
    dataset: str,
    factor: float,
    enough: int,
) -> None:
    monkeypatch.setattr("visloc_extensions.living_maps.updating.placing._MIN_LIFTED", enough)
    root = Path(shutil.copytree(captures / dataset, tmp_path / "longer"))
    for depth in root.rglob("*.depth"):
        depth.write_bytes((np.fromfile(depth, "<f4") * np.float32(factor)).tobytes())

    error = refused(root, maps_dir, poses=poses)

    assert error.code == "update.elsewhere"
    assert "by depth, what they see is" in error.message
    assert "--depth-scale" in str(error.expected)


def test_photos_without_poses_are_placed_where_they_localize(
    captures: Path, maps_dir: Path, walk: Path, tmp_path: Path
) -> None:
    bare = tmp_path / "bare"
    shutil.copytree(
        captures / "second", bare, symlinks=True, ignore=shutil.ignore_patterns("trajectories.txt")
    )
    photo = bare / "sensors" / "records_data"
    photo.unlink()  # a link
    shutil.copytree(walk / "mapping" / "sensors" / "records_data", photo)
    cv2.imwrite(str(photo / "mapping/left/0002.jpg"), np.zeros((192, 256, 3), np.uint8))

    done = update(bare, maps_dir, poses="localize")
    opened = open_map(done.folder)
    assert np.median(errors_of_poses(opened, walk, 8)[:, 0]) < 0.01
    assert done.record.photos == done.record.localized == 7
    assert done.record.not_localized == {"no_keypoints": 1}
    assert done.notes == ("bare: 1 of 8 photos found no place: mapping/left/0002.jpg",)
    assert done.notes[0] in opened.manifest.notes


def test_the_same_names_need_a_name_for_the_capture(
    captures: Path, maps_dir: Path, walk: Path
) -> None:
    error = refused(captures / "first", maps_dir)
    assert error.code == "update.photos"
    assert "--capture NAME" in str(error)
    assert "mapping/left/0001.jpg" in str(error)

    again = open_map(update(captures / "first", maps_dir, capture="again").folder)
    assert again.images[8].name == "again/mapping/left/0001.jpg"
    assert errors_of_poses(again, walk)[:, 0].max() < 0.01
    assert again.cameras.keys() == {"left", "right"}
    assert refused(captures / "first", maps_dir, capture="again").code == "update.photos"


def test_a_map_by_matches_takes_a_capture_of_another_unit_and_one_with_depth(
    captures: Path, tmp_path: Path, walk: Path, build_walk: Callable[..., Map]
) -> None:
    before = build_walk(captures / "first", tmp_path)
    done = update(captures / "scaled", tmp_path, metric=False)
    assert done.record.method == "sfm"
    assert_allclose(done.record.scale, 1 / 3, rtol=2e-3)
    grown = open_map(done.folder)
    assert errors_of_poses(grown, walk, 8)[:, 0].max() < 0.02
    assert len(grown.landmarks) > 1.2 * len(before.landmarks)
    assert grown.rigs == before.rigs or len(grown.rigs) == 2

    by_depth = update(captures / "second", tmp_path, method="rgbd", capture="again")
    opened = verify_map(by_depth.folder)
    assert errors_of_poses(opened, walk, 16)[:, 0].max() < 0.02
    assert len(opened.manifest.method.settings["updates"]) == 2  # type: ignore[arg-type]


class Stopped(Exception):
    pass


def test_stopped_before_the_end_it_finds_its_work_again_and_makes_the_same_map(
    captures: Path, maps_dir: Path, updated: tuple[Map, Updated]
) -> None:
    def stop(stage: str, _done: int, _total: int) -> None:
        if stage == "archive":
            raise Stopped

    def items() -> dict[Path, int]:
        found = (maps_dir / ".work" / "walk").glob("*/*.npz")
        return {path: path.stat().st_mtime_ns for path in found}

    settings = UpdateSettings("walk", captures / "second", maps_dir)
    for _ in range(2):
        with pytest.raises(Stopped):
            update_map(settings, stop)
        first = items()
    assert {path.parent.name for path in first} >= {"local_features", "localized", "lifted"}
    with pytest.raises(Stopped):
        update_map(settings, stop)
    assert items() == first

    done = update_map(settings, quiet)
    again = open_map(done.folder)
    assert again.manifest.content_hash == updated[0].manifest.content_hash
    assert not (maps_dir / ".work" / "walk").exists()
    assert len(MapStore(maps_dir).versions("walk")) == 2


def test_two_processes_make_the_same_map(
    captures: Path, maps_dir: Path, updated: tuple[Map, Updated]
) -> None:
    done = update(captures / "second", maps_dir, workers=2)
    assert open_map(done.folder).manifest.content_hash == updated[0].manifest.content_hash


def test_another_version_that_came_into_use_is_not_lost(captures: Path, maps_dir: Path) -> None:
    store = MapStore(maps_dir)
    old = store.current_version("walk")
    update(captures / "second", maps_dir, capture="again")
    new = store.current_version("walk")
    error = refused(captures / "second", maps_dir, map_ref=f"walk@{old}")
    assert error.code == "map.outdated"

    def switch(stage: str, _done: int, _total: int) -> None:
        if stage == "archive":
            store.set_current("walk", old)

    with pytest.raises(Conflict) as caught:
        update_map(UpdateSettings("walk", captures / "second", maps_dir), switch)
    assert caught.value.code == "map.outdated"
    assert store.versions("walk") == sorted([old, new])


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"poses": "guess"}, "update.poses"),
        ({"method": "model"}, "update.method"),
        ({"capture": "../up"}, "update.capture"),
        ({"depth_scale": float("nan")}, "update.depth_scale"),
    ],
)
def test_settings_that_mean_nothing_are_refused(
    changes: dict[str, object], code: str, captures: Path, maps_dir: Path
) -> None:
    assert refused(captures / "second", maps_dir, **changes).code == code


def test_options_left_out_give_the_defaults(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("MAPS_DIR", "WEIGHTS_DIR"):
        monkeypatch.delenv(f"VISLOC_{name}", raising=False)
    expected = UpdateSettings("m", Path("data"), workers=DEFAULT_WORKERS)
    assert settings_of(UpdateSettings, "m", "data") == expected


def test_the_command_says_how_many_photos_were_tied_and_how_well(
    captures: Path,
    maps_dir: Path,
    other_room: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def run(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["mapping", "update", *map(str, arguments)])
        with pytest.raises(SystemExit) as left:
            cli.main()
        return int(left.value.code or 0), *capsys.readouterr()

    status, out, err = run(
        *("walk", other_room, "--capture=other", "--maps-dir", maps_dir, "--workers=1")
    )
    assert (status, out) == (1, "")
    assert err.count("error [update.elsewhere]") == 1

    status, out, _ = run("walk", captures / "second", "--maps-dir", maps_dir, "--workers=1")
    assert status == 0
    lines = out.splitlines()
    assert re.fullmatch(
        r"capture second: 8 photos, \d+ observations, \d+ new landmarks \(rgbd\)", lines[0]
    )
    assert lines[1] == "localized 8 of 8 photos that were tried"
    assert re.match(
        r"8 photos tied, median residual 0\.\d\d px, 0\.00\d+ m, .*; scale 1$", lines[2]
    )
    assert re.match(r"map walk@\S+: 16 photos, ", lines[3])
