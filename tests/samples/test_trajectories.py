from __future__ import annotations

import itertools

import numpy as np
import pytest

from samples.render import render_depth
from samples.scene import Scene
from samples.trajectories import mapping_trajectory, query_trajectory, stereo_rig
from visloc.geometry import Camera, Pose, rotation_angle


def apart(first: Pose, second: Pose) -> tuple[float, float]:
    """Metres and degrees between two poses."""
    angle = rotation_angle(first.rotation @ second.rotation.T)
    return float(np.linalg.norm(first.center - second.center)), float(np.degrees(angle))


def test_poses_are_rigid_upright_and_looking_ahead() -> None:
    for pose in [*mapping_trajectory(30), *query_trajectory(10, 30)]:
        np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(pose.rotation) == pytest.approx(1)
        right, down, forward = pose.rotation
        assert down[2] < -0.85  # the camera's y axis points to the floor
        assert abs(forward[2]) < 0.5
        assert abs(right[2]) < 0.15


@pytest.mark.parametrize("num_instants", [2, 10, 30, 200])
def test_neighbours_in_the_mapping_run_overlap(num_instants: int) -> None:
    for first, second in itertools.pairwise(mapping_trajectory(num_instants)):
        metres, degrees = apart(first, second)
        assert metres < 0.6
        assert 0 < degrees < 35


@pytest.mark.parametrize("num_instants", [1, 10, 30, 200])
def test_queries_are_near_the_mapping_run_but_not_on_it(num_instants: int) -> None:
    mapped = mapping_trajectory(num_instants)
    for query in query_trajectory(max(1, num_instants // 3), num_instants):
        distances = [apart(query, pose) for pose in mapped]
        assert min(metres for metres, _ in distances) > 0.05
        assert any(metres < 0.5 and degrees < 25 for metres, degrees in distances)


def test_the_full_run_sees_all_walls_floor_and_ceiling_and_keeps_its_distance(room: Scene) -> None:
    camera = Camera("PINHOLE", 64, 48, (45.8, 45.8, 32.0, 24.0))
    x, y = np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5)
    rays = np.stack([(x - 32) / 45.8, (y - 24) / 45.8, np.ones_like(x)], axis=-1)
    seen = []
    for pose in mapping_trajectory(30):
        depth = render_depth(room, camera, pose)
        assert depth.min() > 0.6
        seen.append(pose.inverse().apply(rays * depth[..., None]).reshape(-1, 3))
    points = np.concatenate(seen)
    for axis, value in ((0, -3), (0, 3), (1, -2.25), (1, 2.25), (2, 0), (2, 2.8)):
        assert np.mean(np.abs(points[:, axis] - value) < 1e-6) > 0.01


def test_rig_cameras_are_two_decimetres_apart_left_and_right() -> None:
    rig = stereo_rig(640, 480)
    left, right = rig["left"], rig["right"]
    baseline = right.cam_from_rig.center - left.cam_from_rig.center
    np.testing.assert_allclose(baseline, [0.2, 0, 0], atol=1e-12)
    _, degrees = apart(left.cam_from_rig, right.cam_from_rig)
    assert 2 < degrees < 8
    # Left looks to the left: the world's point ahead appears right of its centre.
    ahead = left.cam_from_rig.apply(np.array([0.0, 0.0, 1e6]))
    assert ahead[0] > 0
    assert left.camera.params != right.camera.params
    for mounted in rig.values():
        assert 65 < np.degrees(2 * np.arctan(320 / mounted.camera.params[0])) < 75
