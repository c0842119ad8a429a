from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from visloc.kapture import read_dataset


@pytest.mark.parametrize(
    ("folder", "num_images", "num_depth_maps", "num_fixes"),
    [
        ("redkitchen/mapping", 60, 60, 0),
        ("redkitchen/query", 39, 0, 0),
        ("castle/mapping", 21, 0, 0),
        ("castle/query", 9, 0, 0),
        ("kitti_curve/mapping", 52, 0, 0),
        ("kitti_curve/query", 50, 0, 0),
        ("virtual_gallery/query", 4, 0, 0),
        ("import_samples/rgbd_png", 6, 6, 0),
        ("import_samples/kapture_berlin", 3, 0, 3),
        ("import_samples/kapture_maupertuis", 4, 0, 4),
    ],
)
def test_real_datasets_are_read_whole_and_every_photo_has_a_pose(
    shared_data: Path, folder: str, num_images: int, num_depth_maps: int, num_fixes: int
) -> None:
    dataset = read_dataset(shared_data / folder)
    assert len(dataset.images) == num_images
    assert len(dataset.depth_maps) == num_depth_maps
    assert len(dataset.gnss) == num_fixes
    assert all(dataset.pose(record) is not None for record in dataset.images)
    assert all(dataset.path_of(record).is_file() for record in dataset.images)
    assert dataset.notes == ()


def test_virtual_gallery_names_cameras_that_it_does_not_have(shared_data: Path) -> None:
    dataset = read_dataset(shared_data / "virtual_gallery" / "mapping")
    assert dataset.notes == (
        "sensors/rigs.txt: 4 members that sensors.txt does not have were left out"
        " (first in line 5: training_camera_2)",
    )
    assert len(dataset.images) == 12
    assert all(dataset.pose(record) is not None for record in dataset.images)


def test_the_stairs_sample_lists_files_that_it_does_not_have(shared_data: Path) -> None:
    dataset = read_dataset(shared_data / "import_samples" / "kapture_7scenes_stairs")
    assert [note.split(" (")[0] for note in dataset.notes] == [
        "sensors/records_camera.txt: 3 files do not exist",
        "sensors/records_depth.txt: 6 files do not exist",
    ]


def test_the_stereo_baseline_lies_between_the_poses_of_a_rig(shared_data: Path) -> None:
    dataset = read_dataset(shared_data / "kitti_curve" / "mapping")
    left, right = (dataset.pose(record) for record in dataset.images[:2])
    assert left is not None
    assert right is not None
    np.testing.assert_allclose(left.apply(right.center), [0.5371657188644179, 0, 0], atol=1e-12)
