from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.methods.rgbd import (
    LiftedKeypoints,
    leave_out_far,
    lift_keypoints,
    merge_landmarks,
    rounded_length,
)
from mapping.stages.depth import DepthMatch
from mapping.stages.photos import MappingPhoto
from visloc.errors import InvalidInput
from visloc.geometry import Camera, Pose
from visloc.kapture import Dataset, FileRecord

CAMERA = Camera("PINHOLE", 64, 48, (60.0, 62.0, 31.0, 25.0))
POSE = Pose.from_quaternion([0.9, 0.1, -0.3, 0.2], [0.3, -0.2, 0.5])


def make_photo(name: str = "a.jpg", pose: Pose = POSE, depth: bool = True) -> MappingPhoto:
    record = FileRecord(timestamp=0, sensor_id="cam", path=name)
    match = DepthMatch(FileRecord(0, "depth", "a.depth"), CAMERA, Pose.identity())
    return MappingPhoto(
        record, Path(name), "", CAMERA, True, pose, match if depth else None, "" if depth else None
    )


def dataset_with_depth(root: Path, depth: NDArray[np.float32]) -> Dataset:
    folder = root / "sensors" / "records_data"
    folder.mkdir(parents=True)
    depth.astype("<f4").tofile(folder / "a.depth")
    return Dataset(root, {}, {}, {}, (), (), (), ())


def test_keypoints_are_lifted_to_where_the_plane_is(tmp_path: Path) -> None:
    # The plane z = 2 + 0.2 x in the camera's frame, seen at every pixel centre.
    u, _ = np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5)
    slope = (u - 31.0) / 60.0
    depth = (2.0 / (1.0 - 0.2 * slope)).astype(np.float32)
    keypoints = np.array([[10.3, 7.9], [40.75, 30.25], [63.9, 10.0]], dtype=np.float32)

    lifted = lift_keypoints(dataset_with_depth(tmp_path, depth), make_photo(), keypoints, 0.001)

    assert lifted.rows.tolist() == [0, 1]  # the third has no neighbour on its right
    in_camera = POSE.apply(lifted.points)
    assert in_camera[:, 2] == pytest.approx(2.0 + 0.2 * in_camera[:, 0], abs=1e-5)
    u = 60.0 * in_camera[:, 0] / in_camera[:, 2] + 31.0
    assert u == pytest.approx(keypoints[:2, 0], abs=1e-4)


def test_a_photo_without_depth_gives_nothing(tmp_path: Path) -> None:
    dataset = dataset_with_depth(tmp_path, np.ones((48, 64), np.float32))
    lifted = lift_keypoints(dataset, make_photo(depth=False), np.ones((3, 2), np.float32), 0.001)
    assert len(lifted.rows) == 0
    assert lifted.points.shape == (0, 3)


def lifted_at(photo: MappingPhoto, *points: tuple[float, float, float]) -> LiftedKeypoints:
    world = np.array(points).reshape(-1, 3)
    seen = photo.pose.apply(world)
    u = 60.0 * seen[:, 0] / seen[:, 2] + 31.0
    v = 62.0 * seen[:, 1] / seen[:, 2] + 25.0
    pixels = np.column_stack([u, v]).astype(np.float32)
    # every second feature had no depth
    return LiftedKeypoints(2 * np.arange(len(points)), pixels, world)


def test_points_of_one_voxel_become_one_landmark_with_their_observations() -> None:
    photos = [make_photo("a.jpg", Pose.identity()), make_photo("b.jpg", Pose.identity())]
    lifted = [
        lifted_at(photos[0], (0.011, 0.001, 2.001), (0.5, 0.5, 3.001)),
        lifted_at(photos[1], (0.013, 0.003, 2.003), (0.014, 0.002, 2.002), (-0.5, 0.5, 4.001)),
    ]

    landmarks, rows = merge_landmarks(photos, lifted, voxel_size=0.01)

    assert len(landmarks.points) == 3
    assert landmarks.offsets.tolist() == [0, 2, 4]
    first, second, third, fourth = landmarks.observed.tolist()
    assert first == third
    assert len({first, second, fourth}) == 3
    # the second photo sees it twice: its strongest keypoint stays
    assert [kept.tolist() for kept in rows] == [[0, 2], [0, 4]]
    assert landmarks.points[first] == pytest.approx([0.012, 0.002, 2.002], abs=1e-6)
    assert landmarks.track_lengths[[first, second, fourth]].tolist() == [2, 1, 1]
    assert landmarks.errors_px[second] == pytest.approx(0.0, abs=1e-4)
    # 1.4 mm at 2 m with a focal length of 60 px
    assert landmarks.errors_px[first] == pytest.approx(0.042, abs=0.005)
    assert landmarks.keypoints[3].tolist() == lifted[1].pixels[2].tolist()


def test_far_from_the_origin_millimetres_survive() -> None:
    center = np.array([500_000.0, 4_600_000.0, 120.0])
    pose = Pose(np.eye(3), -center)
    photo = make_photo("a.jpg", pose)
    x, y, z = center
    lifted = lifted_at(photo, (x + 0.0011, y, z + 2.0), (x + 0.5, y, z + 2.0))
    landmarks, _ = merge_landmarks([photo], [lifted], voxel_size=0.01)
    positions = landmarks.points.astype(np.float64) + landmarks.origin
    assert np.sort(positions[:, 0] - center[0]) == pytest.approx([0.0011, 0.5], abs=1e-6)


def test_no_depth_anywhere_is_refused_with_a_hint() -> None:
    with pytest.raises(InvalidInput, match="--depth-sensor"):
        leave_out_far([make_photo()], [lifted_at(make_photo())])


def test_keypoints_beyond_a_thousand_medians_are_left_out_and_counted() -> None:
    photos = [make_photo("a.jpg"), make_photo("b.jpg", Pose.identity())]
    seen = [(0.0, 0.0, 0.04), (0.0, 0.0, 0.05), (0.0, 0.0, 49.0), (0.0, 0.0, 1e10)]
    at_depths = [POSE.inverse().apply(np.array(seen)), np.array([(0.0, 0.0, 0.05)])]
    lifted = [
        lifted_at(photo, *map(tuple, points))
        for photo, points in zip(photos, at_depths, strict=True)
    ]

    median, notes = leave_out_far(photos, lifted)

    assert median == pytest.approx(0.05)
    assert [one.rows.tolist() for one in lifted] == [[0, 2, 4], [0]]
    assert [len(one.points) for one in lifted] == [len(one.pixels) for one in lifted] == [3, 1]
    assert len(notes) == 1
    assert notes[0].startswith("1 of 5 keypoints")


@pytest.mark.parametrize(
    ("length", "rounded"),
    [(0.0095, 0.01), (0.0072, 0.01), (0.014, 0.01), (0.0145, 0.02), (2.09e-4, 2e-4), (10.04, 10.0)],
)
def test_voxels_are_rounded_to_1_2_or_5_times_a_power_of_ten(length: float, rounded: float) -> None:
    assert rounded_length(length) == rounded


def test_a_voxel_size_that_would_overflow_is_refused() -> None:
    photo = make_photo()
    lifted = lifted_at(photo, (0.0, 0.0, 1.0), (1e7, 1e7, 1e7))
    with pytest.raises(InvalidInput, match="--voxel-size"):
        merge_landmarks([photo], [lifted], voxel_size=1e-6)
