from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from visloc.geometry import rotation_angle
from visloc.pose.average import average_pose, deviations

RANDOM = np.random.default_rng(0)


def test_poses_on_both_sides_average_to_the_middle() -> None:
    middle, axis = Rotation.random(rng=RANDOM), np.array([0.3, -0.5, 0.2])
    rotations = np.stack(
        [(Rotation.from_rotvec(sign * axis) * middle).as_matrix() for sign in (-1, 1)]
    )
    centers = np.array([[1.0, 2.0, 3.0], [3.0, 2.0, -1.0]])

    pose = average_pose(rotations, centers, np.array([0.5, 0.5]))

    np.testing.assert_allclose(pose.rotation, middle.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(pose.center, [2.0, 2.0, 1.0], atol=1e-12)


def test_a_weight_of_one_is_that_pose() -> None:
    rotations, centers = Rotation.random(4, rng=RANDOM).as_matrix(), RANDOM.normal(size=(4, 3))

    pose = average_pose(rotations, centers, np.array([0.0, 0.0, 1.0, 0.0]))

    np.testing.assert_allclose(pose.rotation, rotations[2], atol=1e-12)
    np.testing.assert_allclose(pose.center, centers[2], atol=1e-12)


def test_weights_pull_the_rotation() -> None:
    turns = Rotation.from_rotvec([[0.0, 0.0, 0.0], [0.0, 0.0, 0.2]]).as_matrix()

    pose = average_pose(turns, np.zeros((2, 3)), np.array([0.75, 0.25]))

    # For small angles, the mean of angles.
    assert rotation_angle(pose.rotation) == pytest.approx(0.05, rel=0.01)


def test_deviations_lead_from_the_pose_to_the_others() -> None:
    rotations, centers = Rotation.random(3, rng=RANDOM).as_matrix(), RANDOM.normal(size=(3, 3))
    pose = average_pose(rotations, centers, np.full(3, 1 / 3))

    turned, moved = deviations(pose, rotations, centers)

    np.testing.assert_allclose(
        Rotation.from_rotvec(turned).as_matrix() @ pose.rotation, rotations, atol=1e-12
    )
    np.testing.assert_allclose(pose.center + moved, centers, atol=1e-12)
