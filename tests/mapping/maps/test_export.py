from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import PIL.Image  # noqa: F401  before pycolmap
import pycolmap
import pytest
from numpy.typing import NDArray

from mapping.importers import import_dataset
from mapping.maps.editing import content_of
from mapping.maps.export import EXPORTERS, export_map
from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from visloc.archive import (
    FingerprintRecord,
    GlobalFeatures,
    ImageRecord,
    Landmarks,
    Map,
    MapContent,
    MapStore,
    open_map,
    pose_row,
    write_map,
)
from visloc.errors import Conflict, DatasetError, InvalidInput
from visloc.geometry import Camera, Pose
from visloc.kapture import open_features, read_dataset, read_reconstruction

ORIGIN = np.array([500_000.25, 4_000_000.5, 10.0])
CAMERAS = {
    "left": Camera("PINHOLE", 64, 48, (50.5, 51.0, 32.0, 24.25)),
    "right": Camera("SIMPLE_RADIAL", 80, 60, (70.0, 40.0, 30.0, -0.125)),
}
NAMES = ("left/0.jpg", "right/0.jpg", "left/1 b.jpg")
OBSERVED = [0, 1, 3, 0, 2, 3, 3]
OFFSETS = [0, 3, 3, 7]


def make_map(
    folder: Path,
    *,
    names: tuple[str, ...] = NAMES,
    local: str = "sift",
    has_colors: bool = True,
) -> Map:
    """Three photos, the second of which sees nothing; six landmarks, of which 4 and 5 are unseen.

    The last photo sees landmark 3 twice.
    """
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(7, 8)).astype(np.float32)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    points = rng.normal(size=(6, 3)).astype(np.float32)
    cameras = ("left", "right", "left")
    content = MapContent(
        metric=True,
        method="model",
        settings={},
        notes=(),
        cameras=CAMERAS,
        rigs={"rig": {name: pose_row(Pose.identity()) for name in CAMERAS}},
        images=tuple(
            ImageRecord(name=name, camera=camera, timestamp=10 * i)
            for i, (name, camera) in enumerate(zip(names, cameras, strict=True))
        ),
        image_poses=np.array(
            [pose_row(Pose.from_quaternion(rng.normal(size=4), rng.normal(size=3))) for _ in names]
        ),
        landmarks=Landmarks(
            origin=ORIGIN,
            points=points,
            track_lengths=np.array([2, 1, 1, 2, 0, 0], np.uint16),
            errors_px=np.array([0.5, 0.25, 1, 2, np.nan, np.nan], np.float32),
            angles_deg=np.full(6, np.nan, np.float32),
            offsets=np.array(OFFSETS),
            observed=np.array(OBSERVED, np.uint32),
            keypoints=rng.uniform(0, 48, (7, 2)).astype(np.float32),
            colors=rng.integers(0, 255, (6, 3)).astype(np.uint8) if has_colors else None,
        ),
        local_fingerprint=FingerprintRecord(name=local, revision=1, parameters={}),
        max_keypoints=100,
        descriptor_dim=8,
        descriptors=lambda: iter([rows[:3], rows[3:3], rows[3:]]),
        global_features=(
            GlobalFeatures(
                FingerprintRecord(name="kapture:AP-GeM", revision=1, parameters={}),
                np.eye(3, 4, dtype=np.float32),
                {},
            ),
        ),
    )
    folder.mkdir()
    write_map(folder, content, map_id="room", version="v1", created="2026-01-02T03:04:05+00:00")
    return open_map(folder)


@pytest.fixture
def opened(tmp_path: Path) -> Map:
    return make_map(tmp_path / "map")


def points_of(opened: Map) -> NDArray[np.float64]:
    points: NDArray[np.float64] = opened.landmarks.astype(np.float64) + ORIGIN
    return points


def test_pycolmap_reads_the_same_cameras_poses_and_points(opened: Map, tmp_path: Path) -> None:
    export_map(opened, tmp_path / "out" / "model", "colmap")
    model = pycolmap.Reconstruction(tmp_path / "out" / "model")
    assert (model.num_rigs(), model.num_frames(), model.num_reg_images()) == (2, 3, 3)
    for number, camera in enumerate(CAMERAS.values(), 1):
        theirs = model.cameras[number]
        assert theirs.model.name == camera.model
        assert (theirs.width, theirs.height) == (camera.width, camera.height)
        assert tuple(theirs.params) == camera.params
    for row, name in enumerate(NAMES):
        image = model.images[row + 1]
        assert image.name == name
        assert image.camera_id == (2 if name.startswith("right") else 1)
        pose = image.cam_from_world()
        quaternion = pose.rotation.quat[[3, 0, 1, 2]]
        quaternion *= np.sign(quaternion[0])
        np.testing.assert_allclose(quaternion, opened.image_poses[row, :4], rtol=0, atol=1e-15)
        assert pose.translation.tolist() == opened.image_poses[row, 4:].tolist()
        seen = slice(OFFSETS[row], OFFSETS[row + 1])
        assert [point.point3D_id - 1 for point in image.points2D] == OBSERVED[seen]
        xy = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
        assert np.array_equal(xy, opened.keypoints(row))
    assert opened.colors is not None
    points = [model.points3D[index + 1] for index in range(6)]
    assert np.array_equal([point.xyz for point in points], points_of(opened))
    assert np.array_equal([point.color for point in points], opened.colors)
    assert [point.error for point in points] == [0.5, 0.25, 1, 2, -1, -1]
    assert [point.track.length() for point in points] == [2, 1, 1, 3, 0, 0]


def test_photos_of_one_camera_and_time_are_told_apart_in_kapture(
    opened: Map, tmp_path: Path
) -> None:
    content = content_of(opened)
    same = ImageRecord("left/again.jpg", "left", content.images[0].timestamp)
    images = (*content.images[:2], same)
    (tmp_path / "twice").mkdir()
    write_map(
        tmp_path / "twice",
        replace(content, images=images),
        map_id="room",
        version="v2",
        created="2026-01-02T03:04:05+00:00",
    )
    twice = open_map(tmp_path / "twice")

    notes = export_map(twice, tmp_path / "dataset", "kapture")

    dataset = read_dataset(tmp_path / "dataset")
    poses = {record.path: dataset.pose(record) for record in dataset.images}
    assert poses.keys() == {image.name for image in images}
    for image, row in zip(images, opened.image_poses, strict=True):
        pose = poses[image.name]
        assert pose is not None
        assert pose.translation.tolist() == row[4:].tolist()
    times = {record.path: record.timestamp for record in dataset.images}
    assert [times[image.name] for image in images[:2]] == [i.timestamp for i in images[:2]]
    assert times[same.name] > max(image.timestamp for image in images)
    assert notes == (
        "1 of 3 photos have a later timestamp than in the map, which has several of one camera at "
        "one time",
    )
    assert export_map(opened, tmp_path / "once", "kapture") == ()


def test_our_reader_reads_the_same_dataset(opened: Map, tmp_path: Path) -> None:
    output = tmp_path / "dataset"
    export_map(opened, output, "kapture")
    dataset = read_dataset(output)
    (note,) = dataset.notes  # a map has no photos
    assert "3 files do not exist" in note
    assert {name: sensor.camera for name, sensor in dataset.sensors.items()} == CAMERAS
    assert [record.path for record in dataset.images] == list(NAMES)
    assert list(dataset.rigs["rig"]) == list(CAMERAS)
    for row, record in enumerate(dataset.images):
        pose = dataset.pose(record)
        assert pose is not None
        expected = opened.image_poses[row]
        np.testing.assert_allclose(pose.rotation_wxyz, expected[:4], rtol=0, atol=1e-15)
        assert pose.translation.tolist() == expected[4:].tolist()
        keypoints = open_features(output, "keypoints", "sift").read(record.path)
        descriptors = open_features(output, "descriptors", "sift").read(record.path)
        vector = open_features(output, "global_features", "AP-GeM").read(record.path)
        assert np.array_equal(keypoints, opened.keypoints(row))
        scale = np.float32(opened.manifest.local_features.descriptor_scale)
        assert np.array_equal(descriptors, opened.observations(row)[1] * scale)
        assert np.array_equal(vector, [np.eye(3, 4)[row]])
    known = read_reconstruction(output)
    assert known is not None
    assert known.keypoints_type == "sift"
    assert np.array_equal(known.points, points_of(opened))
    assert known.colors is not None
    assert opened.colors is not None
    assert np.array_equal(known.colors, opened.colors)
    assert {(p, known.images[i], k) for p, i, k in known.observations.tolist()} == {
        (point, NAMES[row], index)
        for row in range(3)
        for index, point in enumerate(OBSERVED[OFFSETS[row] : OFFSETS[row + 1]])
    }


def test_fixes_of_the_dataset_come_back_as_they_were(
    built_maps: Path, sample: Path, tmp_path: Path
) -> None:
    dataset = read_dataset(sample / "mapping")
    assert dataset.gnss
    export_map(MapStore(built_maps).open("room"), tmp_path / "out", "kapture")
    again = read_dataset(tmp_path / "out")
    assert again.gnss == dataset.gnss
    receiver = dataset.gnss[0].sensor_id
    assert again.sensors[receiver].params == dataset.sensors[receiver].params


def test_ready_made_features_keep_their_own_name(tmp_path: Path) -> None:
    export_map(make_map(tmp_path / "map", local="kapture:r2d2_500"), tmp_path / "out", "kapture")
    assert open_features(tmp_path / "out", "keypoints", "r2d2_500").read(NAMES[0]) is not None


@pytest.mark.parametrize("has_colors", [True, False])
def test_a_point_cloud_keeps_every_digit(tmp_path: Path, has_colors: bool) -> None:
    opened = make_map(tmp_path / "map", has_colors=has_colors)
    export_map(opened, tmp_path / "cloud.ply", "ply")
    header, _, body = (tmp_path / "cloud.ply").read_bytes().partition(b"end_header\n")
    assert b"element vertex 6\n" in header
    layout = [("xyz", "<f8", 3), *([("rgb", "u1", 3)] if has_colors else [])]
    vertices = np.frombuffer(body, layout)
    assert np.array_equal(vertices["xyz"], points_of(opened))
    if opened.colors is not None:
        assert np.array_equal(vertices["rgb"], opened.colors)
        cloud = pycolmap.Reconstruction()
        cloud.import_PLY(tmp_path / "cloud.ply")
        read = sorted(point.xyz.tolist() for point in cloud.points3D.values())
        np.testing.assert_allclose(read, sorted(points_of(opened).tolist()))


def test_a_map_without_colours_is_black_in_colmap(tmp_path: Path) -> None:
    opened = make_map(tmp_path / "map", has_colors=False)
    export_map(opened, tmp_path / "model", "colmap")
    points = pycolmap.Reconstruction(tmp_path / "model").points3D.values()
    assert {tuple(point.color.tolist()) for point in points} == {(0, 0, 0)}


def make_folder(path: Path) -> None:
    path.mkdir()


def make_dangling_link(path: Path) -> None:
    path.symlink_to(path.with_name("nowhere"))


@pytest.mark.parametrize("name", list(EXPORTERS))
@pytest.mark.parametrize("make", [Path.touch, make_folder, make_dangling_link])
def test_what_exists_is_left_alone(
    opened: Map, tmp_path: Path, name: str, make: Callable[[Path], None]
) -> None:
    make(tmp_path / "out")
    before = sorted(tmp_path.iterdir())
    with pytest.raises(Conflict) as caught:
        export_map(opened, tmp_path / "out", name)
    assert caught.value.code == "export.exists"
    assert sorted(tmp_path.iterdir()) == before


def test_a_failure_leaves_nothing(tmp_path: Path) -> None:
    opened = make_map(tmp_path / "map", names=("a.jpg", "b,c.jpg", "d.jpg"))
    with pytest.raises(DatasetError):
        export_map(opened, tmp_path / "out", "kapture")
    assert [path.name for path in tmp_path.iterdir()] == ["map"]


def test_an_unknown_format_is_answered_with_the_known_ones(opened: Map, tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="colmap, kapture, ply"):
        export_map(opened, tmp_path / "out", "nvm")


def test_a_real_model_imported_built_and_exported_is_the_model_that_it_was(
    shared_data: Path, tmp_path: Path
) -> None:
    door = shared_data / "import_samples" / "lund_door"
    import_dataset("colmap", door / "colmap", tmp_path / "dataset")
    settings = BuildSettings(
        *(tmp_path / "dataset", "door", tmp_path / "maps"),
        method="model",
        local_features="sift",
        global_features=("localvlad",),
        max_keypoints=500,
        metric=False,
    )
    build_map(settings, lambda *_: None)
    export_map(MapStore(tmp_path / "maps").open("door"), tmp_path / "model", "colmap")
    before, after = (
        pycolmap.Reconstruction(door / "colmap"),
        pycolmap.Reconstruction(tmp_path / "model"),
    )
    (old_camera,), (new_camera,) = before.cameras.values(), after.cameras.values()
    assert (new_camera.model, new_camera.width, new_camera.height) == (
        old_camera.model,
        old_camera.width,
        old_camera.height,
    )
    assert np.array_equal(new_camera.params, old_camera.params)
    images = {image.name: image for image in before.images.values()}
    assert sorted(image.name for image in after.images.values()) == sorted(images)
    for image in after.images.values():
        old, new = images[image.name].cam_from_world(), image.cam_from_world()
        quaternion = old.rotation.quat / np.linalg.norm(old.rotation.quat)  # six digits there
        assert abs(quaternion @ new.rotation.quat) == pytest.approx(1, abs=1e-15)
        assert np.array_equal(new.translation, old.translation)
    old_points = [before.points3D[key] for key in sorted(before.points3D)]
    new_points = [after.points3D[key] for key in sorted(after.points3D)]
    assert np.array_equal([p.color for p in new_points], [p.color for p in old_points])
    np.testing.assert_allclose(  # single precision in the map
        [p.xyz for p in new_points], [p.xyz for p in old_points], rtol=0, atol=2e-6
    )
