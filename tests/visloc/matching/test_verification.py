from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from visloc.geometry import Pose
from visloc.matching.verification import epipolar_errors

RANDOM = np.random.default_rng(0)
POINTS = RANDOM.uniform([-1, -1, 4], [1, 1, 6], (200, 3))
B_FROM_A = Pose(Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix(), np.array([0.3, 0.2, 0.1]))


def rays_to(points: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(points / points[:, 2:])


def test_rays_to_one_point_meet() -> None:
    errors = epipolar_errors(rays_to(POINTS), rays_to(B_FROM_A.apply(POINTS)), B_FROM_A)
    assert errors.max() < 1e-12


@pytest.mark.parametrize("length", [1e-6, 1e6])
def test_the_length_of_the_baseline_does_not_matter(length: float) -> None:
    a, b = rays_to(POINTS), rays_to(B_FROM_A.apply(POINTS))
    b[:, 0] += 0.01
    scaled = Pose(B_FROM_A.rotation, B_FROM_A.translation * length)
    np.testing.assert_allclose(
        epipolar_errors(a, b, scaled), epipolar_errors(a, b, B_FROM_A), rtol=1e-6
    )


def test_the_error_is_the_distance_to_the_line_in_the_photo_that_is_further_off() -> None:
    sideways = Pose(np.eye(3), np.array([-1.0, 0.0, 0.0]))
    a = np.array([[0.0, 0.0, 1.0]])
    b = np.array([[-0.2, 0.003, 1.0]])  # epipolar lines are rows
    np.testing.assert_allclose(epipolar_errors(a, b, sideways), [0.003], rtol=1e-12)


def test_both_directions_give_the_same_error() -> None:
    a = rays_to(POINTS)
    b = rays_to(B_FROM_A.apply(POINTS) + RANDOM.normal(0, 0.02, POINTS.shape))
    np.testing.assert_allclose(
        epipolar_errors(a, b, B_FROM_A), epipolar_errors(b, a, B_FROM_A.inverse()), rtol=1e-9
    )


def test_rays_that_meet_behind_the_cameras_never_fit() -> None:
    behind = -POINTS
    errors = epipolar_errors(rays_to(behind), rays_to(B_FROM_A.apply(behind)), B_FROM_A)
    assert np.isinf(errors).all()


def test_rays_of_one_centre_and_rays_that_are_nan_never_fit() -> None:
    a, b = rays_to(POINTS), rays_to(B_FROM_A.apply(POINTS))
    assert np.isinf(epipolar_errors(a, b, Pose(B_FROM_A.rotation, np.zeros(3)))).all()
    a[3] = np.nan
    b[5] = np.nan
    errors = epipolar_errors(a, b, B_FROM_A)
    assert np.isinf(errors[[3, 5]]).all()
    assert np.isfinite(np.delete(errors, [3, 5])).all()
