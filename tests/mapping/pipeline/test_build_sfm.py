from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.maps.cameras import cameras_of
from mapping.methods.sfm_settings import SfmSettings
from mapping.pairing import PAIRINGS, PairSettings
from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from mapping.sample import ANCHOR_ALTITUDE_M, ANCHOR_LATITUDE_DEG, ANCHOR_LONGITUDE_DEG
from visloc.archive import Map, MapStore
from visloc.errors import DatasetError, InvalidInput, NotFound, VislocError
from visloc.evaluation import pose_error
from visloc.geodesy import enu_from_geodetic, geodetic_from_enu
from visloc.geometry import Camera, Pose
from visloc.kapture import GnssRecord, Sensor, read_dataset

Build = Callable[..., Map]
Errors = Callable[[Map, Path], NDArray[np.float64]]
Rewrite = Callable[..., None]


def sfm(**settings: object) -> SfmSettings:
    return SfmSettings(**settings)  # type: ignore[arg-type]


def poses_of(opened: Map) -> dict[str, NDArray[np.float64]]:
    return {image.name: pose for image, pose in zip(opened.images, opened.image_poses, strict=True)}


def test_queries_are_localized_to_millimetres_in_a_map_by_matches(
    walk: Path, sfm_walk: Map, localization_errors: Errors
) -> None:
    errors = localization_errors(sfm_walk, walk / "query")
    assert np.median(errors, axis=0) == pytest.approx([0.0, 0.0], abs=0.1)
    assert errors[:, 0].max() < 0.01
    assert errors[:, 1].max() < 0.2


def test_given_poses_are_in_the_map_bit_by_bit(walk: Path, sfm_walk: Map) -> None:
    dataset, found = read_dataset(walk / "mapping"), poses_of(sfm_walk)
    assert sfm_walk.manifest.world.metric
    assert sfm_walk.manifest.world.anchor is not None
    assert sfm_walk.manifest.world.anchor.kind == "dataset"
    for record in dataset.images:
        pose = dataset.pose(record)
        assert pose is not None
        assert np.array_equal(found[record.path], [*pose.rotation_wxyz, *pose.translation])
    assert dict(sfm_walk.cameras) == {
        name: sensor.camera for name, sensor in dataset.sensors.items() if sensor.kind == "camera"
    }


def test_landmarks_tell_how_well_they_were_seen(sfm_walk: Map) -> None:
    assert sfm_walk.track_lengths.min() >= 2
    assert sfm_walk.errors_px.max() <= 4.0
    assert sfm_walk.angles_deg.min() >= 1.5
    assert sfm_walk.manifest.method.name == "sfm"
    assert sfm_walk.manifest.method.settings["pairs"] == ["retrieval"]


@pytest.mark.parametrize("names", [*((name,) for name in PAIRINGS), ("sequence", "distance")])
def test_every_pairing_makes_a_map_that_localizes(
    walk: Path,
    tmp_path: Path,
    rgbd_walk: Map,
    build_walk: Build,
    localization_errors: Errors,
    names: tuple[str, ...],
) -> None:
    pairing = PairSettings(top_k=5, max_distance=3, near=0.3, far=8)
    settings = sfm(pairs=names, pairing=pairing, covisible_in=rgbd_walk)
    built = build_walk(walk / "mapping", tmp_path, sfm=settings)
    assert built.manifest.method.settings["pairs"] == list(names)
    assert localization_errors(built, walk / "query")[:, 0].max() < 0.03
    num_pairs = len((built.path / "pairs.txt").read_text().splitlines()) - 1
    assert (num_pairs == 16 * 15 / 2) == (names == ("exhaustive",))


@pytest.mark.slow
def test_the_pairs_in_a_map_make_the_same_map_again(
    walk: Path, tmp_path: Path, build_walk: Build
) -> None:
    settings = sfm(pairs=("sequence", "retrieval"), pairing=PairSettings(top_k=4))
    paired = build_walk(walk / "mapping", tmp_path, sfm=settings)
    pairs = paired.path / "pairs.txt"
    again = build_walk(walk / "mapping", tmp_path, sfm=sfm(pairs_file=pairs))
    third = build_walk(walk / "mapping", tmp_path, sfm=sfm(pairs_file=again.path / "pairs.txt"))
    assert again.manifest.content_hash == third.manifest.content_hash
    files = again.manifest.files
    # The settings say where the pairs came from; all else is the same, pairs.txt included.
    assert files == paired.manifest.files
    assert "pairs.txt" in files


@pytest.mark.parametrize("refine", [("points",), ("poses",), ("intrinsics",)])
def test_what_is_refined_changes_and_nothing_else_and_the_frame_stays(
    walk: Path,
    tmp_path: Path,
    sfm_walk: Map,
    build_walk: Build,
    localization_errors: Errors,
    refine: tuple[str, ...],
) -> None:
    built = build_walk(walk / "mapping", tmp_path, sfm=sfm(refine=refine))
    assert built.manifest.method.settings["refine"] == list(refine)
    before, after = poses_of(sfm_walk), poses_of(built)
    same = [np.array_equal(before[name], after[name]) for name in before]
    assert all(same) == (refine != ("poses",))
    assert (dict(built.cameras) == dict(sfm_walk.cameras)) == (refine != ("intrinsics",))
    moved = [
        pose_error(Pose.from_quaternion(a[:4], a[4:]), Pose.from_quaternion(b[:4], b[4:]))
        for a, b in zip(before.values(), after.values(), strict=True)
    ]
    assert np.max(moved, axis=0) == pytest.approx([0.0, 0.0], abs=0.3)
    assert localization_errors(built, walk / "query")[:, 0].max() < 0.02


def test_a_focal_length_far_from_the_known_one_stays_as_known_and_is_told(
    walk_copy: Path, tmp_path: Path, build_walk: Build, rewrite: Rewrite
) -> None:
    sensors = dict(read_dataset(walk_copy).sensors)
    true = sensors["left"].camera
    assert true is not None
    params = (1.15 * true.focal_length, true.width / 2, true.height / 2, 0.0)
    wrong = Camera("SIMPLE_RADIAL", true.width, true.height, params)
    sensors["left"] = Sensor.with_camera("left", wrong, name="Maker One (EXIF)")
    rewrite(walk_copy, sensors=sensors)
    built = build_walk(walk_copy, tmp_path / "maps", sfm=sfm(refine=("intrinsics",)))
    left, right = (cameras_of(built)[name] for name in ("left", "right"))
    assert built.cameras["left"] == wrong
    assert (left.source, left.moved_percent, left.doubt) == ("exif", 0.0, "moved")
    assert (right.source, right.doubt) == ("given", None)
    (note,) = (note for note in built.manifest.notes if "focal length" in note)
    assert f"left: {wrong.focal_length:.1f} px of EXIF" in note


ANCHOR = np.array([ANCHOR_LATITUDE_DEG, ANCHOR_LONGITUDE_DEG, ANCHOR_ALTITUDE_M])
ESTIMATE = SfmSettings(pairing=PairSettings(top_k=4), poses="estimate")


def centers_of(dataset: Path) -> dict[str, NDArray[np.float64]]:
    read = read_dataset(dataset)
    return {r.path: pose.center for r in read.images if (pose := read.pose(r)) is not None}


@pytest.mark.slow
def test_without_any_position_the_world_is_said_to_be_arbitrary(
    walk_copy: Path, tmp_path: Path, build_walk: Build, rewrite: Rewrite
) -> None:
    known = read_dataset(walk_copy)
    unknown = {
        name: Sensor(name, "", "camera", ("UNKNOWN_CAMERA", "256", "192"), None)
        for name in ("left", "right")
    }
    rewrite(walk_copy, sensors=unknown, rigs={}, trajectories={}, gnss=(), depth_maps=())
    built = build_walk(walk_copy, tmp_path / "maps", sfm=ESTIMATE)
    world = built.manifest.world
    assert not world.metric
    assert world.anchor is not None
    assert (world.anchor.kind, world.anchor.images, world.anchor.rms) == ("none", 0, None)
    assert any("the frame and unit are arbitrary" in note for note in built.manifest.notes)
    # What the lenses are was found too: a guess of 307 px became what it is.
    for name, camera in built.cameras.items():
        truth = known.sensors[name].camera
        assert truth is not None
        assert camera.model == "SIMPLE_RADIAL"
        assert camera.focal_length == pytest.approx(truth.focal_length, rel=0.1)
    assert {camera.source for camera in cameras_of(built).values()} == {"estimated"}


@pytest.mark.slow
def test_gnss_says_where_the_map_lies_and_one_fix_of_another_country_does_no_harm(
    walk: Path, walk_copy: Path, tmp_path: Path, build_walk: Build, rewrite: Rewrite
) -> None:
    far = 52.52, 13.405, 34.0
    dataset, random = read_dataset(walk_copy), np.random.default_rng(0)
    fixes, images = [], []
    for stamp, record in enumerate(dataset.images):
        pose = dataset.pose(record)
        assert pose is not None
        at = pose.center + random.normal(0, 0.01, 3)
        latitude, longitude, altitude = geodetic_from_enu(at[None], ANCHOR)[0]
        if stamp == 3:
            latitude, longitude, altitude = far
        fixes.append(GnssRecord(stamp, "gnss", longitude, latitude, altitude, 0.0, 0.0))
        images.append(replace(record, timestamp=stamp))
    changes = {"images": tuple(images), "gnss": tuple(fixes)}
    rewrite(walk_copy, rigs={}, trajectories={}, depth_maps=(), **changes)

    built = build_walk(walk_copy, tmp_path / "maps", sfm=ESTIMATE, metric=False)

    world = built.manifest.world
    assert world.metric
    assert world.anchor is not None
    assert (world.anchor.kind, world.anchor.images) == ("gnss", 15)
    assert world.anchor.rms is not None
    assert world.anchor.rms < 0.2
    geodetic = world.anchor.geodetic
    assert geodetic is not None
    origin = np.array([geodetic.latitude_deg, geodetic.longitude_deg, geodetic.altitude_m])
    assert np.linalg.norm(enu_from_geodetic(origin[None], ANCHOR)) < 20
    (note,) = [note for note in built.manifest.notes if "contradict" in note]
    assert "1 of 16 known positions (gnss) contradict the others by more than 10" in note
    # The world's axes point east, north and up of that origin.
    truth = centers_of(walk / "mapping")
    expected = enu_from_geodetic(geodetic_from_enu(np.array(list(truth.values())), ANCHOR), origin)
    poses = poses_of(built)
    found = [Pose.from_quaternion(poses[name][:4], poses[name][4:]).center for name in truth]
    assert np.linalg.norm(found - expected, axis=1).max() < 0.15


@pytest.mark.slow
def test_poses_of_some_photos_anchor_all_of_them(
    walk: Path,
    walk_copy: Path,
    tmp_path: Path,
    build_walk: Build,
    rewrite: Rewrite,
    localization_errors: Errors,
) -> None:
    stamps = sorted({record.timestamp for record in read_dataset(walk_copy).images})
    kept = set(stamps[::3])
    dataset = read_dataset(walk_copy)
    poses = {
        (record.timestamp, record.sensor_id): pose
        for record in dataset.images
        if record.timestamp in kept and (pose := dataset.pose(record)) is not None
    }
    rewrite(walk_copy, rigs={}, trajectories=poses, gnss=(), depth_maps=())

    built = build_walk(walk_copy, tmp_path / "maps", sfm=ESTIMATE)

    anchor = built.manifest.world.anchor
    assert built.manifest.world.metric
    assert anchor is not None
    assert (anchor.kind, anchor.images) == ("positions", len(poses))
    assert anchor.rms is not None
    assert anchor.rms < 0.05
    errors = localization_errors(built, walk / "query")
    assert np.median(errors[:, 0]) < 0.03
    assert errors[:, 0].max() < 0.1
    # So short a walk tells which way the world is turned to 1 or 2 degrees only.
    assert errors[:, 1].max() < 3.0


def relative_to_rig(built: Map, instants: int = 8) -> NDArray[np.float64]:
    """How far apart the photos of each instant are, as a part of what the map's rig says."""
    poses = {
        (record.timestamp, record.camera): Pose.from_quaternion(row[:4], row[4:])
        for record, row in zip(built.images, built.image_poses, strict=True)
    }
    rig = built.rigs["rig"]
    known = rig["right"] @ rig["left"].inverse()
    found = [
        poses[stamp, "right"] @ pose.inverse()
        for (stamp, sensor), pose in poses.items()
        if sensor == "left" and (stamp, "right") in poses
    ]
    assert len(found) == instants
    length = np.linalg.norm(known.translation)
    return np.array([np.linalg.norm(p.translation - known.translation) / length for p in found])


def test_a_rig_gives_the_unit_and_positions_the_place(
    walk_copy: Path, tmp_path: Path, build_walk: Build, rewrite: Rewrite
) -> None:
    truth = read_dataset(walk_copy)
    rewrite(walk_copy, depth_maps=())
    built = build_walk(walk_copy, tmp_path / "maps", sfm=ESTIMATE)
    assert built.manifest.world.metric
    assert built.manifest.world.anchor is not None
    assert built.manifest.world.anchor.kind == "positions"
    assert not [doubt for doubt in built.manifest.parts.doubts if doubt.kind == "unit"]
    assert relative_to_rig(built).max() < 1e-6
    for sensor, pose in truth.rigs["rig"].items():
        if sensor in built.rigs["rig"] and pose is not None:
            np.testing.assert_allclose(built.rigs["rig"][sensor].translation, pose.translation)


def test_a_rig_gives_the_unit_where_nothing_gives_the_place(
    walk_copy: Path, tmp_path: Path, build_walk: Build, rewrite: Rewrite
) -> None:
    rewrite(walk_copy, trajectories={}, gnss=(), depth_maps=())
    built = build_walk(walk_copy, tmp_path / "maps", sfm=ESTIMATE)
    assert built.manifest.world.metric
    assert any(note.endswith("the frame is arbitrary") for note in built.manifest.notes)
    assert relative_to_rig(built).max() < 1e-6


@pytest.mark.slow
def test_photos_of_kitti_stand_apart_as_their_rig_says(shared_data: Path, tmp_path: Path) -> None:
    dataset = shared_data / "kitti_curve" / "mapping"
    settings = BuildSettings(dataset, "kitti", tmp_path, method="sfm", sfm=sfm(poses="estimate"))
    build_map(settings, lambda *_: None)
    built = MapStore(tmp_path).open("kitti")
    assert relative_to_rig(built, instants=26).max() < 1e-6
    assert np.linalg.norm(built.rigs["rig"]["right"].translation) == pytest.approx(0.5371657)


def test_a_rig_of_half_its_size_contradicts_the_positions(
    walk_copy: Path, tmp_path: Path, build_walk: Build, rewrite: Rewrite
) -> None:
    truth = read_dataset(walk_copy)
    poses = {
        (record.timestamp, record.sensor_id): pose
        for record in truth.images
        if (pose := truth.pose(record)) is not None
    }
    halved = {
        sensor: pose and Pose(pose.rotation, pose.translation / 2)
        for sensor, pose in truth.rigs["rig"].items()
    }
    rewrite(walk_copy, rigs={"rig": halved}, trajectories=poses, depth_maps=())
    with pytest.raises(NotFound, match="no version of the map is current"):
        build_walk(walk_copy, tmp_path / "maps", sfm=ESTIMATE)
    store = MapStore(tmp_path / "maps")
    (version,) = store.versions("walk")
    built = store.open(f"walk@{version}")
    (doubt,) = (doubt for doubt in built.manifest.parts.doubts if doubt.kind == "unit")
    factor = re.search(r"should be ([0-9.]+) times as large", doubt.message)
    assert factor is not None
    assert float(factor[1]) == pytest.approx(2.0, rel=0.1)
    assert relative_to_rig(built).max() < 1e-6


def append(name: str, *lines: str) -> Callable[[Path], None]:
    def change(dataset: Path) -> None:
        path = dataset / "sensors" / name
        path.write_text(path.read_text() + "".join(f"{line}\n" for line in lines))

    return change


def replace_in(name: str, before: str, after: str) -> Callable[[Path], None]:
    def change(dataset: Path) -> None:
        path = dataset / "sensors" / name
        text = path.read_text()
        assert re.search(before, text)
        path.write_text(re.sub(before, after, text))

    return change


@pytest.mark.parametrize(
    ("damage", "code", "named"),
    [
        (
            append("records_camera.txt", "9, left, mapping/left/0001.jpg"),
            "kapture.duplicate",
            r"sensors/records_camera.txt:19.*mapping/left/0001.jpg",
        ),
        (
            append("records_camera.txt", "1700000000000, left, mapping/left/0009.jpg"),
            "kapture.duplicate",
            r"sensors/records_camera.txt:19.*1700000000000, left",
        ),
        (
            append("trajectories.txt", "1700000000000, rig, 1, 0, 0, 0, 0, 0, 0"),
            "kapture.duplicate",
            r"sensors/trajectories.txt:\d+.*1700000000000, rig",
        ),
        (
            replace_in("sensors.txt", "camera, PINHOLE", "camera, FISHY"),
            "camera.model",
            r"sensors/sensors.txt:\d+.*FISHY",
        ),
        (
            replace_in(
                "sensors.txt", "camera, PINHOLE, 256, 192.*", "camera, UNKNOWN_CAMERA, 256, 192"
            ),
            "dataset.no_photos",
            r"16 of 16 photos have a camera of unknown model: mapping/left/0001.jpg",
        ),
        (
            lambda dataset: (dataset / "sensors" / "records_data").unlink(),
            "dataset.no_photos",
            r"16 of 16 photos are listed, but the file is absent: mapping/left/0001.jpg",
        ),
    ],
)
def test_a_bad_dataset_is_refused_by_name_and_nothing_is_published(
    walk_copy: Path,
    tmp_path: Path,
    build_walk: Build,
    damage: Callable[[Path], None],
    code: str,
    named: str,
) -> None:
    damage(walk_copy)
    with pytest.raises(DatasetError, match=named) as caught:
        build_walk(walk_copy, tmp_path / "maps")
    assert caught.value.code == code
    assert not (tmp_path / "maps" / "walk").exists()


@pytest.mark.parametrize(
    ("text", "code", "named"),
    [
        ("mapping/left/0001.jpg, elsewhere.jpg\n", "pairs.unknown_photo", r"my.txt:1.*elsewhere"),
        ("# nothing\n", "pairs.none", r"my.txt: the pairing found no pair"),
        (
            "mapping/left/0001.jpg, mapping/right/0008.jpg\n",
            "sfm.no_matches",
            "too few matches for triangulation",
        ),
    ],
)
def test_pairs_that_make_no_map_leave_the_one_before(
    walk: Path,
    tmp_path: Path,
    rgbd_walk: Map,
    build_walk: Build,
    text: str,
    code: str,
    named: str,
) -> None:
    shutil.copytree(rgbd_walk.path.parent, tmp_path / "walk")
    pairs = tmp_path / "my.txt"
    pairs.write_text(text)
    with pytest.raises(VislocError, match=named) as caught:
        build_walk(walk / "mapping", tmp_path, sfm=sfm(pairs_file=pairs))
    assert caught.value.code == code
    assert sorted(path.name for path in (tmp_path / "walk").iterdir()) == sorted(
        ["current", rgbd_walk.path.name]
    )
    assert MapStore(tmp_path).open("walk").manifest == rgbd_walk.manifest


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"sfm": SfmSettings(pairs=("nearest",))}, "--pairs.*retrieval.*got nearest"),
        ({"sfm": SfmSettings(pairs=("distance", "distance"))}, "--pairs: a name is given twice"),
        ({"sfm": SfmSettings(refine=("rigs",))}, "--refine.*poses, points, intrinsics.*got rigs"),
        ({"sfm": SfmSettings(mapper="config3")}, "--mapper.*config1, config2.*got config3"),
        ({"sfm": SfmSettings(poses="estimate", refine=("poses",))}, "--refine"),
        ({"sfm": SfmSettings(poses="estimate"), "method": "rgbd"}, "--poses.*--method sfm"),
    ],
)
def test_a_wrong_setting_names_its_option(
    walk: Path, tmp_path: Path, build_walk: Build, changes: dict[str, object], named: str
) -> None:
    with pytest.raises(InvalidInput, match=named):
        build_walk(walk / "mapping", tmp_path, **changes)
    assert not list(tmp_path.iterdir())
