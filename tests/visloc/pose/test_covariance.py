from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from samples.trajectories import stereo_rig
from visloc.geometry import Camera, Pose
from visloc.pose.covariance import pose_covariance
from visloc.pose.generalized import estimate_generalized_pose
from visloc.pose.motion import position_covariance, with_origin
from visloc.pose.refinement import LOSS_SCALE_PX
from visloc.pose.reprojection import MatchedView, normalized_rays, project

CAMERA = Camera("PINHOLE", 640, 480, (500.0, 510.0, 322.0, 239.0))
ALONE = [Pose.identity()]
SURROUND = [
    Pose(Rotation.from_euler("y", a, degrees=True).as_matrix(), np.array([0.1, 0.0, -0.3]))
    for a in (0.0, 90.0, 180.0, 270.0)
]

SAMPLE_RIG = [mounted.cam_from_rig for mounted in stereo_rig(640, 480).values()]


def look(seed: int, cams_from_rig: list[Pose], n: int) -> tuple[list[MatchedView], Pose]:
    """Exact correspondences, n in all, and the pose of the rig."""
    rng = np.random.default_rng(seed)
    truth = Pose(Rotation.from_rotvec(rng.normal(size=3)).as_matrix(), rng.normal(size=3))
    views = []
    for cam_from_rig in cams_from_rig:
        pixels = rng.uniform([5, 5], [635, 475], (n // len(cams_from_rig), 2))
        seen = normalized_rays(CAMERA, pixels) * rng.uniform(1.0, 6.0, (len(pixels), 1))
        points = (cam_from_rig @ truth).inverse().apply(seen)
        views.append(MatchedView(CAMERA, cam_from_rig, pixels, points))
    return views, truth


def noisy(
    views: list[MatchedView], truth: Pose, rng: np.random.Generator, noise_px: float, power: float
) -> list[MatchedView]:
    """Pixels with noise that grows with the distance of the point to a power."""
    found = []
    for view in views:
        distance = np.linalg.norm((view.cam_from_rig @ truth).apply(view.points), axis=1)
        noise = rng.normal(size=view.pixels.shape) * noise_px * distance[:, None] ** power
        found.append(replace(view, pixels=view.pixels + noise))
    return found


def normalized_errors(
    cams_from_rig: list[Pose], n: int, noise_px: float, power: float = 0.0
) -> NDArray[np.float64]:
    """Squared errors (200,) of seeded trials, normalized by the stated covariance."""
    rng = np.random.default_rng(7)
    normalized = []
    for trial in range(200):
        exact, truth = look(trial, cams_from_rig, n)
        views = noisy(exact, truth, rng, noise_px, power)
        found = estimate_generalized_pose(views, max_error_px=30.0, seed=0)
        assert found is not None
        assert found.covariance is not None
        estimate = found.rig_from_world
        w = Rotation.from_matrix(truth.rotation @ estimate.rotation.T).as_rotvec()
        error = np.concatenate([w, truth.translation - estimate.translation])
        normalized.append(error @ np.linalg.solve(found.covariance, error))
    return np.array(normalized)


@pytest.mark.parametrize(
    ("cams_from_rig", "num_points", "noise_px", "far_points_scatter_more"),
    [
        (ALONE, 32, 0.3, False),
        (ALONE, 32, 2.0, False),
        (ALONE, 152, 2.0, False),
        (ALONE, 32, 0.3, True),
        (ALONE, 152, 0.3, True),
        (SURROUND, 32, 2.0, False),
        (SURROUND, 32, 0.3, True),
    ],
)
def test_covariance_agrees_with_monte_carlo(
    cams_from_rig: list[Pose], num_points: int, noise_px: float, far_points_scatter_more: bool
) -> None:
    """The squared error, normalized by the stated covariance, is at most chi-square(6).

    At most: the wider of two estimates is stated, so that the mean of 200 trials, which is
    6 +- 0.25 when the statement is exact, comes out a little lower; lower still when the two
    disagree, because distant points scatter more.
    """
    power = 1.5 if far_points_scatter_more else 0.0
    normalized = normalized_errors(cams_from_rig, num_points, noise_px, power)
    inside = np.mean(normalized < chi2.ppf(0.95, 6))
    assert inside >= 0.92
    assert (3.0 if far_points_scatter_more else 4.5) <= np.mean(normalized) <= 6.6


@pytest.mark.parametrize("cams_from_rig", [SAMPLE_RIG, SURROUND, ALONE])
def test_the_mean_normalized_error_is_within_the_chi_square_band(
    cams_from_rig: list[Pose],
) -> None:
    low, high = (float(chi2.ppf(share, 6 * 200)) / 200 for share in (0.025, 0.975))
    assert low <= np.mean(normalized_errors(cams_from_rig, 400, 1.0)) <= high


def direct_covariance(view: MatchedView, pose: Pose) -> NDArray[np.float64]:
    """The formulas for one pinhole camera, written out: Huber's, and the sandwich."""
    fx, fy, cx, cy = view.camera.params
    jacobian, residuals = [], []
    for pixel, point in zip(view.pixels, view.points, strict=True):
        x, y, z = pose.rotation @ point + pose.translation
        residuals.append([fx * x / z + cx - pixel[0], fy * y / z + cy - pixel[1]])
        by_point = np.array([[fx / z, 0, -fx * x / z**2], [0, fy / z, -fy * y / z**2]])
        a, b, c = pose.rotation @ point
        turning = np.array([[0, c, -b], [-c, 0, a], [b, -a, 0]])
        jacobian.append(by_point @ np.hstack([turning, np.eye(3)]))
    information, bread, meat = np.zeros((3, 6, 6))
    slope, psi2 = 0.0, 0.0
    for j, r in zip(np.array(jacobian), np.array(residuals), strict=True):
        weight = 1 / (1 + r @ r / LOSS_SCALE_PX**2)
        curvature = weight * np.eye(2) - 2 * (weight / LOSS_SCALE_PX) ** 2 * np.outer(r, r)
        information += j.T @ j
        bread += j.T @ curvature @ j
        meat += np.outer(j.T @ (weight * r), j.T @ (weight * r))
        slope += np.trace(curvature)
        psi2 += weight**2 * (r @ r)
    num_residuals = 2 * len(view)
    spare = num_residuals - 6
    common = np.linalg.inv(information) * psi2 / spare / (slope / num_residuals) ** 2
    sandwich = np.linalg.inv(bread) @ meat @ np.linalg.inv(bread) * num_residuals / spare
    root = np.linalg.cholesky(common)
    sandwich /= 1 + 2 / math.sqrt(len(view))  # its own scatter
    ratios, axes = np.linalg.eigh(np.linalg.solve(root, np.linalg.solve(root, sandwich).T))
    half = root @ axes * np.sqrt(np.maximum(ratios, 1.0))
    return np.asarray(half @ half.T)


def covariance_of(views: Sequence[MatchedView], rig_from_world: Pose) -> NDArray[np.float64] | None:
    found = pose_covariance(views, rig_from_world, LOSS_SCALE_PX)
    if found is None:
        return None
    assert found.of_camera is None  # all focal lengths are known here
    return found.whole


def test_one_camera_has_the_covariance_of_the_direct_formula() -> None:
    exact, truth = look(3, ALONE, 40)
    views = noisy(exact, truth, np.random.default_rng(3), 1.0, 0.5)
    covariance = covariance_of(views, truth)
    assert covariance is not None
    expected = direct_covariance(views[0], truth)
    scale = np.sqrt(np.diag(expected))
    unitless = covariance / np.outer(scale, scale)
    assert unitless == pytest.approx(expected / np.outer(scale, scale), abs=1e-5)


def test_where_the_rig_has_its_origin_does_not_change_what_is_known() -> None:
    """The same cameras, named from another origin: the covariance moves along with it."""
    exact, truth = look(4, SURROUND, 80)
    views = noisy(exact, truth, np.random.default_rng(4), 1.0, 0.0)
    old_from_new = Pose(Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix(), np.array([1.0, 2, 0]))
    renamed = [replace(view, cam_from_rig=view.cam_from_rig @ old_from_new) for view in views]
    new_from_world = old_from_new.inverse() @ truth
    old = covariance_of(views, truth)
    new = covariance_of(renamed, new_from_world)
    assert old is not None
    assert new is not None
    # R_new = Q R_old and t_new = Q (t_old - t), so that w_new = Q w_old and dt_new = Q dt_old.
    turn = np.kron(np.eye(2), old_from_new.rotation.T)
    assert new == pytest.approx(turn @ old @ turn.T, rel=1e-6, abs=1e-9)


def test_far_from_the_origin_the_centre_is_as_uncertain_or_undetermined() -> None:
    """There, rotation and translation are nearly the same, and rounding eats what tells them."""
    num_stated = 0
    for seed in range(80):
        exact, truth = look(seed, ALONE, 40)
        (view,) = noisy(exact, truth, np.random.default_rng(seed), 1.0, 0.0)
        near = covariance_of([view], truth)
        assert near is not None
        away = 1e4 * (0.8 + 0.02 * seed) * np.array([0.6, 0.64, 0.48])
        shifted = Pose(truth.rotation, truth.translation - truth.rotation @ away)
        far = covariance_of([replace(view, points=view.points + away)], shifted)
        if far is not None:
            num_stated += 1
            stated, expected = position_covariance(shifted, far), position_covariance(truth, near)
            assert np.trace(stated) == pytest.approx(np.trace(expected), rel=0.05)
    assert num_stated >= 20


def test_views_without_inliers_do_not_matter() -> None:
    views, truth = look(5, SURROUND, 80)
    empty = replace(views[0], pixels=np.empty((0, 2)), points=np.empty((0, 3)))
    assert covariance_of([empty, *views[1:]], truth) == pytest.approx(
        covariance_of(views[1:], truth)
    )
    assert covariance_of([empty], truth) is None
    assert covariance_of([], truth) is None


def test_points_at_the_very_edge_of_a_fisheye_count_as_none() -> None:
    camera = Camera("OPENCV_FISHEYE", 640, 640, (200.0, 200.0, 320.0, 320.0, 0.0, 0.0, 0.0, 0.0))
    points = np.random.default_rng(6).uniform([-3.0, -3.0, 1.0], [3.0, 3.0, 5.0], (50, 3))
    edge = np.vstack([points, [[5.0, 0.0, 2e-5]]])
    clear, with_edge = (
        MatchedView(camera, Pose.identity(), project(camera, seen) + 0.5, seen)
        for seen in (points, edge)
    )
    expected = covariance_of([clear], Pose.identity())
    assert expected is not None
    found = covariance_of([with_edge], Pose.identity())
    assert found is not None
    assert np.array_equal(found, expected)


@pytest.mark.parametrize("cams_from_rig", [ALONE, SURROUND[:1] * 2])
def test_collinear_points_leave_the_covariance_undetermined(cams_from_rig: list[Pose]) -> None:
    points = np.column_stack([np.linspace(-1, 1, 20), np.zeros(20), np.full(20, 3.0)])
    views = [
        MatchedView(CAMERA, cam_from_rig, project(CAMERA, cam_from_rig.apply(points)), points)
        for cam_from_rig in cams_from_rig
    ]
    assert covariance_of(views, Pose.identity()) is None


def test_position_covariance_is_that_of_the_centre() -> None:
    rng = np.random.default_rng(0)
    _, pose = look(9, ALONE, 1)
    root = rng.normal(size=(6, 6)) * 1e-3
    covariance = root @ root.T
    samples = rng.normal(size=(20000, 6)) @ root.T
    centers = np.array(
        [
            Pose(
                Rotation.from_rotvec(s[:3]).as_matrix() @ pose.rotation, pose.translation + s[3:]
            ).center
            for s in samples
        ]
    )
    assert position_covariance(pose, covariance) == pytest.approx(
        np.cov(centers.T), rel=0.05, abs=3e-7
    )


def test_moving_the_origin_keeps_centre_rotation_and_their_uncertainty() -> None:
    _, local = look(9, ALONE, 1)
    origin = np.array([500_000.0, 4_600_000.0, 120.0])
    covariance = np.diag([1e-6, 2e-6, 3e-6, 1e-4, 2e-4, 3e-4])
    world, moved = with_origin(local, covariance, origin)
    assert world.center == pytest.approx(local.center + origin, abs=1e-6)
    assert moved[:3, :3] == pytest.approx(covariance[:3, :3])
    assert position_covariance(world, moved) == pytest.approx(
        position_covariance(local, covariance), rel=1e-3, abs=1e-8
    )
