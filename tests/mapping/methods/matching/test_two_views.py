from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.methods.matching.two_views import fits_two_views, log10_chance
from visloc.geometry import Camera, Pose
from visloc.pose.reprojection import project

CAMERA = Camera("OPENCV", 640, 480, (500.0, 510.0, 321.0, 242.0, -0.1, 0.02, 0.001, -0.002))
SECOND = Pose(np.eye(3), np.array([-0.6, 0.1, 0.05]))


def two_photos(num_right: int, num_wrong: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    random = np.random.default_rng(0)
    points = random.uniform([-2, -1.5, 4], [2, 1.5, 8], (num_right, 3))
    wrong = random.uniform([0, 0], [640, 480], (2, num_wrong, 2))
    return (
        np.concatenate([project(CAMERA, points), wrong[0]]).astype(np.float32),
        np.concatenate([project(CAMERA, SECOND.apply(points)), wrong[1]]).astype(np.float32),
    )


@pytest.mark.parametrize("calibrated", [True, False])
def test_right_matches_fit_and_most_wrong_ones_do_not(calibrated: bool) -> None:
    a, b = two_photos(120, 120)
    fits = fits_two_views((CAMERA, CAMERA), a, b, 4.0, calibrated=calibrated)
    assert fits[:120].mean() > 0.97
    assert fits[120:].mean() < 0.15


# A part of the matches finds the geometry, and where too few of the part fit, all do.
@pytest.mark.parametrize(("num_right", "num_wrong"), [(2000, 500), (600, 900)])
@pytest.mark.parametrize("calibrated", [True, False])
def test_of_many_matches_the_right_ones_fit(
    calibrated: bool, num_right: int, num_wrong: int
) -> None:
    a, b = two_photos(num_right, num_wrong)
    fits = fits_two_views((CAMERA, CAMERA), a, b, 4.0, calibrated=calibrated)
    assert fits[:num_right].mean() > 0.97
    assert fits[num_right:].mean() < 0.1


def test_of_many_matches_those_behind_the_cameras_do_not_fit() -> None:
    a, b = two_photos(2000, 0)
    # Pixels whose rays meet behind: those of points seen with the baseline reversed.
    points = np.random.default_rng(2).uniform([-2, -1.5, 4], [2, 1.5, 8], (100, 3))
    reversed_second = Pose(np.eye(3), -SECOND.translation)
    behind = project(CAMERA, points), project(CAMERA, reversed_second.apply(points))
    a, b = (
        np.concatenate([one, other]).astype(np.float32)
        for one, other in zip((a, b), behind, strict=True)
    )
    fits = fits_two_views((CAMERA, CAMERA), a, b, 4.0, calibrated=True)
    assert fits[:2000].mean() > 0.97
    assert not fits[2000:].any()


# Moved by none, 2 px or so, and 30 % of the points nearer than the others; in units of the world.
@pytest.mark.parametrize(("moved", "away"), [(0.0, 1.0), (0.02, 1.0), (-0.02, 1.0), (0.6, 60.0)])
def test_of_many_matches_those_too_far_to_tell_their_side_fit(moved: float, away: float) -> None:
    random = np.random.default_rng(0)
    points = random.uniform([-2, -1.5, 4], [2, 1.5, 8], (2000, 3))
    points[:1400] *= away
    second = Pose(np.eye(3), np.array([moved, 0.0, 0.0]))
    a, b = (
        (project(CAMERA, seen) + random.normal(0, 0.5, (2000, 2))).astype(np.float32)
        for seen in (points, second.apply(points))
    )
    fits = fits_two_views((CAMERA, CAMERA), a, b, 4.0, calibrated=True)
    assert fits.mean() > 0.97


@pytest.mark.parametrize("calibrated", [True, False])
def test_wrong_matches_alone_never_fit(calibrated: bool) -> None:
    a, b = two_photos(0, 1000)
    assert not fits_two_views((CAMERA, CAMERA), a, b, 4.0, calibrated=calibrated).any()


@pytest.mark.parametrize("count", [0, 1, 7])
@pytest.mark.parametrize("calibrated", [True, False])
def test_too_few_matches_do_not_fit(count: int, calibrated: bool) -> None:
    a, b = two_photos(count, 0)
    fits = fits_two_views((CAMERA, CAMERA), a, b, 4.0, calibrated=calibrated)
    assert fits.tolist() == [False] * count


@pytest.mark.parametrize("calibrated", [True, False])
def test_matches_that_the_pose_is_not_estimated_from_may_fit_it(calibrated: bool) -> None:
    a, b = two_photos(120, 120)
    among = np.arange(240) < 90
    fits = fits_two_views((CAMERA, CAMERA), a, b, 4.0, calibrated=calibrated, among=among)
    assert fits[:120].mean() > 0.97
    assert fits[120:].mean() < 0.15


def test_infinitely_far_points_fit_a_motion_without_a_turn_though_few_tell_it() -> None:
    a, b = two_photos(90, 0)
    far = np.random.default_rng(1).uniform([0, 0], [640, 480], (300, 2)).astype(np.float32)
    a, b, among = np.concatenate([a, far]), np.concatenate([b, far]), np.arange(390) < 90
    fits = fits_two_views((CAMERA, CAMERA), a, b, 1.0, calibrated=True, among=among)
    assert fits.mean() > 0.97


def test_pixels_without_a_ray_do_not_fit() -> None:
    camera = Camera("OPENCV", 640, 480, (500.0, 500.0, 320.0, 240.0, -0.9, 0.0, 0.0, 0.0))
    at = np.zeros((50, 2), np.float32)
    assert not fits_two_views((camera, camera), at, at, 4.0, calibrated=True).any()


def test_chance_by_hand() -> None:
    # 10 matches, all inliers, 5 of which fix the pose: 5 * 1 * 252 * 0.01**5.
    assert log10_chance(10, 10, 0.01, calibrated=True) == pytest.approx(math.log10(1260) - 10)
    assert log10_chance(10, 5, 0.01, calibrated=True) == math.inf
    assert log10_chance(10, 7, 0.01, calibrated=False) == math.inf
