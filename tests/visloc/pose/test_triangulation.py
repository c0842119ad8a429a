"""Points from rays of posed photos, against points that are known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from visloc.pose.triangulation import triangulated

CENTERS = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.7, 0.1], [0.5, 0.5, -0.5]])
FOCAL_LENGTHS = np.array([500.0, 500.0, 800.0, 650.0])
MIN_ANGLE = np.radians(1.5)


def rays_to(points: NDArray[np.float64]) -> NDArray[np.float64]:
    away = points[:, None] - CENTERS
    return np.asarray(away / np.linalg.norm(away, axis=2, keepdims=True))


def off_by(rays: NDArray[np.float64], pixels: float, focal_length: float) -> NDArray[np.float64]:
    """Turn rays (n, 3) by so many pixels, across the x axis."""
    turned = rays + np.array([0.0, pixels / focal_length, 0.0])
    return np.asarray(turned / np.linalg.norm(turned, axis=1, keepdims=True))


def solve(rays: NDArray[np.float64], min_angle: float = MIN_ANGLE) -> NDArray[np.float64]:
    return triangulated(rays, CENTERS, FOCAL_LENGTHS, max_error_px=4.0, min_angle=min_angle)


@pytest.fixture
def points() -> NDArray[np.float64]:
    return np.random.default_rng(0).uniform([-3, -3, 4], [3, 3, 12], (200, 3))


def test_exact_rays_give_the_points_that_they_are_of(points: NDArray[np.float64]) -> None:
    assert solve(rays_to(points)) == pytest.approx(points, abs=1e-9)


def test_two_rays_are_enough(points: NDArray[np.float64]) -> None:
    rays = rays_to(points)
    rays[:, 2:] = np.nan
    assert solve(rays) == pytest.approx(points, abs=1e-9)


def test_a_wrong_match_is_outvoted(points: NDArray[np.float64]) -> None:
    rays = rays_to(points)
    rays[:, 1] = off_by(rays[:, 1], 40.0, FOCAL_LENGTHS[1])
    assert solve(rays) == pytest.approx(points, abs=1e-9)


def test_noise_is_averaged_by_pixels(points: NDArray[np.float64]) -> None:
    rng = np.random.default_rng(1)
    rays = rays_to(points)
    noise = rng.normal(size=rays.shape) * 0.5 / FOCAL_LENGTHS[:, None]
    found = solve((rays + noise) / np.linalg.norm(rays + noise, axis=2, keepdims=True))
    assert np.isfinite(found).all()
    # Half a pixel over a base of a metre and 8 metres away.
    depth_std = 8.0**2 / 1.0 * 0.5 / 500.0
    assert np.median(np.linalg.norm(found - points, axis=1)) < depth_std


def test_nothing_comes_of_one_ray_or_of_no_own_ray(points: NDArray[np.float64]) -> None:
    alone, unseen = rays_to(points), rays_to(points)
    alone[:, 1:] = np.nan
    unseen[:, 0] = np.nan
    assert np.isnan(solve(alone)).all()
    assert np.isnan(solve(unseen)).all()


def test_rays_that_do_not_meet_give_no_point(points: NDArray[np.float64]) -> None:
    rays = rays_to(points)
    rays[:, 2:] = np.nan
    rays[:, 1] = off_by(rays[:, 1], 40.0, FOCAL_LENGTHS[1])
    assert np.isnan(solve(rays)).all()


def test_rays_that_meet_behind_the_photos_give_no_point(points: NDArray[np.float64]) -> None:
    assert np.isnan(solve(-rays_to(points))).all()


def test_rays_that_are_nearly_parallel_give_no_point() -> None:
    far, near = np.array([[0.0, 0.0, 100.0]]), np.array([[0.0, 0.0, 10.0]])
    assert np.isnan(solve(rays_to(far))).all()
    assert solve(rays_to(near)) == pytest.approx(near)
    assert solve(rays_to(far), min_angle=np.radians(0.1)) == pytest.approx(far)


def test_photos_from_one_place_tell_nothing() -> None:
    rays = rays_to(np.array([[0.0, 0.0, 5.0]]))[:, :1].repeat(2, axis=1)
    found = triangulated(
        rays, np.zeros((2, 3)), FOCAL_LENGTHS[:2], max_error_px=4.0, min_angle=MIN_ANGLE
    )
    assert np.isnan(found).all()


def test_no_keypoints_and_no_other_photos() -> None:
    assert solve(np.empty((0, 4, 3))).shape == (0, 3)
    alone = triangulated(
        np.array([[[0.0, 0.0, 1.0]]]),
        CENTERS[:1],
        FOCAL_LENGTHS[:1],
        max_error_px=4.0,
        min_angle=MIN_ANGLE,
    )
    assert np.isnan(alone).all()
