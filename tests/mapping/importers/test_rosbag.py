"""A robot's recording becomes a dataset, for both generations of ROS."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapping.importers import import_dataset
from mapping.stages.depth import read_depth
from tests.rosbags_made import SECOND, write_bag
from visloc.errors import DatasetError
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
