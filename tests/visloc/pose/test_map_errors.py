from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from visloc.geometry import Pose, Similarity, center_covariance
from visloc.pose.motion import PHOTO_ONLY, MapErrors, moved_pose, position_covariance
from visloc.types import Uncertainty

RANDOM = np.random.default_rng(0)
POSE = Pose(Rotation.from_rotvec([0.4, -1.0, 2.0]).as_matrix(), np.array([30.0, -7.0, 4.0]))
ROOT = 0.01 * RANDOM.normal(size=(6, 6))
COVARIANCE = ROOT @ ROOT.T


def test_position_and_orientation_are_widened_by_their_own_factors() -> None:
    whole = MapErrors(5.0, 3.0).whole(POSE, COVARIANCE)
    assert position_covariance(POSE, whole) == pytest.approx(
        25.0 * position_covariance(POSE, COVARIANCE)
    )
    assert whole[:3, :3] == pytest.approx(9.0 * COVARIANCE[:3, :3])


def test_how_position_and_rotation_hang_together_stays() -> None:
    before = center_covariance(POSE, COVARIANCE)
    after = center_covariance(POSE, MapErrors(5.0, 3.0).whole(POSE, COVARIANCE))
    assert after[:3, 3:] == pytest.approx(15.0 * before[:3, 3:])


def test_a_doubt_in_the_camera_is_not_the_maps() -> None:
    """Noise of 1 that the map makes 5, and a camera's 2 that stays: 25 + 4."""
    still = Pose(np.eye(3), np.zeros(3))
    of_camera = np.diag([4.0, 0, 0, 4.0, 0, 0])

    whole = MapErrors(5.0, 3.0).whole(still, np.eye(6) + of_camera, of_camera)

    assert np.diag(whole).tolist() == [9.0 + 4, 9, 9, 25.0 + 4, 25, 25]
    assert (PHOTO_ONLY.whole(POSE, COVARIANCE, of_camera) == COVARIANCE).all()


def test_a_bent_map_adds_its_bend_to_every_position_alike() -> None:
    bent, straight = MapErrors(5.0, 3.0, position_std=0.3), MapErrors(5.0, 3.0)
    before, after = straight.whole(POSE, COVARIANCE), bent.whole(POSE, COVARIANCE)

    assert position_covariance(POSE, after) == pytest.approx(
        position_covariance(POSE, before) + 0.09 * np.eye(3)
    )
    assert after[:3] == pytest.approx(before[:3])
    # All instants share it, however many there are.
    assert bent.part(POSE, COVARIANCE) - straight.part(POSE, COVARIANCE) == pytest.approx(
        np.diag([0, 0, 0, 0.09, 0.09, 0.09])
    )


def test_without_a_test_of_the_map_nothing_changes_in_the_last_bit() -> None:
    assert (PHOTO_ONLY.whole(POSE, COVARIANCE) == COVARIANCE).all()
    assert PHOTO_ONLY.uncertainty is Uncertainty.PHOTO_ONLY


def test_another_frame_and_unit_make_no_difference() -> None:
    errors = MapErrors(5.0, 3.0)
    tie = Similarity(2.5, Rotation.from_rotvec([0.3, 0.1, 1.0]).as_matrix(), np.array([9.0, 2, -4]))
    pose, moved = moved_pose(POSE, COVARIANCE, tie)
    _, expected = moved_pose(POSE, errors.whole(POSE, COVARIANCE), tie)
    assert errors.whole(pose, moved) == pytest.approx(expected, rel=1e-6, abs=1e-9)


def test_the_maps_part_and_the_photos_have_the_variances_of_the_whole() -> None:
    errors = MapErrors(5.0, 3.0)
    whole = center_covariance(POSE, errors.whole(POSE, COVARIANCE))
    part = errors.part(POSE, COVARIANCE)
    both = center_covariance(POSE, COVARIANCE + part)

    for block in (slice(0, 3), slice(3, 6)):
        np.testing.assert_allclose(both[block, block], whole[block, block], rtol=1e-9)
    scale = np.sqrt(np.diag(part))
    assert np.linalg.eigvalsh(part / np.outer(scale, scale)).min() > -1e-9
    np.testing.assert_array_equal(PHOTO_ONLY.part(POSE, COVARIANCE), np.zeros((6, 6)))
