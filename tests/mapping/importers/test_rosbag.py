"""A robot's recording becomes a dataset, for both generations of ROS."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from mapping.importers import import_dataset
from mapping.stages.depth import read_depth
from tests.rosbags_made import SECOND, Made, write_bag, write_messages
from visloc.errors import DatasetError
from visloc.geometry import Camera
from visloc.kapture import Dataset, FileRecord, read_dataset


def of_first_camera(dataset: Dataset) -> list[FileRecord]:
    first = dataset.images[0].sensor_id
    return [record for record in dataset.images if record.sensor_id == first]


@pytest.mark.parametrize(("ros1", "compressed"), [(True, False), (False, True), (False, False)])
def test_photos_poses_cameras_and_depth_come_along(
    sample: Path, tmp_path: Path, ros1: bool, compressed: bool
) -> None:
    truth = read_dataset(sample / "mapping")
    bag = tmp_path / ("walk.bag" if ros1 else "walk")
    write_bag(bag, truth, ros1=ros1, compressed=compressed)

    summary = import_dataset("rosbag", bag, tmp_path / "dataset")

    known = of_first_camera(truth)
    read = read_dataset(tmp_path / "dataset")
    assert (summary.images, summary.posed, summary.depth_maps) == (len(known),) * 3
    assert summary.metric
    camera = truth.sensors[known[0].sensor_id].camera
    assert camera is not None
    for number, (record, expected) in enumerate(zip(read.images, known, strict=True)):
        assert record.timestamp == (number + 1) * SECOND
        pose, true = read.pose(record), truth.pose(expected)
        assert pose is not None
        assert true is not None
        np.testing.assert_allclose(pose.rotation, true.rotation, atol=1e-9)
        np.testing.assert_allclose(pose.translation, true.translation, atol=1e-9)
        sensor = read.sensors[record.sensor_id].camera
        assert sensor is not None
        np.testing.assert_allclose(sensor.params, camera.params)
        if compressed:  # as published, byte for byte
            assert read.path_of(record).read_bytes() == truth.path_of(expected).read_bytes()
    depth, expected = (
        read.depth_maps[0],
        next(r for r in truth.depth_maps if r.sensor_id.startswith(known[0].sensor_id)),
    )
    ours, theirs = (
        np.nan_to_num(read_depth(dataset.path_of(r), camera, 0.001))
        for dataset, r in ((read, depth), (truth, expected))
    )
    np.testing.assert_allclose(ours, theirs, atol=6e-4)


def test_photos_of_a_camera_that_stands_are_taken_once(sample: Path, tmp_path: Path) -> None:
    truth = read_dataset(sample / "mapping")
    first = truth.images[0]
    pose = truth.pose(first)
    still = {(record.timestamp, first.sensor_id): pose for record in of_first_camera(truth)}
    standing = Dataset(
        root=truth.root,
        sensors=truth.sensors,
        rigs={},
        trajectories={key: value for key, value in still.items() if value is not None},
        images=tuple(of_first_camera(truth)),
        depth_maps=(),
        gnss=(),
    )
    write_bag(tmp_path / "bag", standing, ros1=False, depth=False)

    summary = import_dataset("rosbag", tmp_path / "bag", tmp_path / "dataset")

    assert summary.images == 1
    assert f"1 of {len(of_first_camera(truth))} photos taken" in summary.notes[0]


def test_a_damaged_bag_leaves_no_dataset(sample: Path, tmp_path: Path) -> None:
    bag = tmp_path / "walk.bag"
    write_bag(bag, read_dataset(sample / "mapping"), ros1=True)
    data = bag.read_bytes()
    bag.write_bytes(data[: len(data) // 2])

    with pytest.raises(DatasetError) as error:
        import_dataset("rosbag", bag, tmp_path / "dataset")
    assert error.value.code == "bag.unreadable"
    assert not (tmp_path / "dataset").exists()
    assert not (tmp_path / "walk_photos").exists()


IMAGE = "sensor_msgs/msg/Image"
PIXELS = np.zeros((48, 64, 3), np.uint8)


def test_photos_that_were_written_go_if_the_import_fails(tmp_path: Path) -> None:
    made = Made(False)
    torn = made.image(2 * SECOND, "camera", PIXELS, "rgb8")
    torn.data = torn.data[:50]
    good = made.image(SECOND, "camera", PIXELS, "rgb8")
    write_messages(tmp_path / "bag", made, [("/c", IMAGE, 1, good), ("/c", IMAGE, 2, torn)])

    with pytest.raises(DatasetError) as error:
        import_dataset("rosbag", tmp_path / "bag", tmp_path / "dataset")
    assert error.value.code == "bag.picture"
    assert not (tmp_path / "bag_photos").exists()

    (tmp_path / "bag_photos").mkdir()  # of somebody else
    with pytest.raises(DatasetError):
        import_dataset("rosbag", tmp_path / "bag", tmp_path / "dataset")
    assert (tmp_path / "bag_photos").exists()


def test_topics_name_folders_but_no_paths_and_never_the_same(tmp_path: Path) -> None:
    made = Made(True)
    topics = ["/a/b", "/a_b", "/..", "/", "/a_b_depth"]
    photo = made.image(SECOND, "camera", PIXELS, "rgb8")
    bag = tmp_path / "in" / "x.bag"
    bag.parent.mkdir()
    write_messages(bag, made, [(topic, IMAGE, 1, photo) for topic in topics])

    summary = import_dataset("rosbag", bag, tmp_path / "dataset")

    assert summary.images == len(topics)
    photos = bag.parent / "x_photos"
    names = sorted(str(path.relative_to(photos).parent) for path in photos.rglob("*.png"))
    assert names == ["a_b", "a_b-2", "a_b_depth-2", "camera", "camera-2"]
    assert sorted(path.name for path in bag.parent.iterdir()) == ["x.bag", "x_photos"]


def test_a_broken_photo_and_one_of_the_same_time_are_left_out(tmp_path: Path) -> None:
    made = Made(False)
    jpeg = cv2.imencode(".jpg", PIXELS)[1].tobytes()
    kind = "sensor_msgs/msg/CompressedImage"
    files = [(1, jpeg), (2, b"no photo"), (3, jpeg), (3, jpeg), (2, jpeg), (9, jpeg)]
    write_messages(
        tmp_path / "bag",
        made,
        [
            ("/c/compressed", kind, number, made.file(second * SECOND, "camera", file))
            for number, (second, file) in enumerate(files)
        ],
    )

    summary = import_dataset("rosbag", tmp_path / "bag", tmp_path / "dataset")

    dataset = read_dataset(tmp_path / "dataset")
    assert [record.timestamp for record in dataset.images] == [s * SECOND for s in (1, 2, 3, 9)]
    assert "/c/compressed: 1 photos cannot be read" in summary.notes


def test_depth_beyond_what_a_depth_map_can_say_is_unknown(tmp_path: Path) -> None:
    made = Made(False)
    metres = np.full((48, 64), 2.0, np.float32)
    metres[0] = 100.0
    camera = Camera("PINHOLE", 64, 48, (60.0, 60.0, 32.0, 24.0))
    info = "sensor_msgs/msg/CameraInfo"
    write_messages(
        tmp_path / "bag",
        made,
        [
            ("/c/image", IMAGE, 1, made.image(SECOND, "camera", PIXELS, "rgb8")),
            ("/c/camera_info", info, 1, made.info(SECOND, "camera", camera)),
            ("/d/image", IMAGE, 1, made.image(SECOND, "camera", metres, "32FC1")),
        ],
    )

    import_dataset("rosbag", tmp_path / "bag", tmp_path / "dataset")

    dataset = read_dataset(tmp_path / "dataset")
    units = cv2.imread(str(dataset.path_of(dataset.depth_maps[0])), cv2.IMREAD_UNCHANGED)
    assert (units[0] == 0).all()
    assert (units[1:] == 2000).all()


def test_depth_without_intrinsics_is_left_out(tmp_path: Path) -> None:
    made = Made(False)
    depth = np.full((48, 64), 1500, np.uint16)
    write_messages(
        tmp_path / "bag",
        made,
        [
            ("/c/image", IMAGE, 1, made.image(SECOND, "camera", PIXELS, "rgb8")),
            ("/d/image", IMAGE, 1, made.image(SECOND, "camera", depth, "16UC1")),
        ],
    )

    summary = import_dataset("rosbag", tmp_path / "bag", tmp_path / "dataset")

    assert (summary.images, summary.depth_maps) == (1, 0)
    assert "/d/image: depth left out, of no photo's frame, time and camera" in summary.notes
