from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from visloc.evaluation import pose_error
from visloc.geometry import CAMERA_MODELS, Camera, Pose
from visloc.pose.absolute import LOSS_SCALE_PX, estimate_absolute_pose, reprojection_errors
from visloc.pose.colmap import normalized_rays, project
from visloc.pose.covariance import pose_covariance, position_covariance, with_origin

CAMERA = Camera("PINHOLE", 640, 480, (500.0, 510.0, 322.0, 239.0))
DISTORTION = {"k": 0.02, "k1": 0.03, "k2": -0.01, "p1": 1e-3, "p2": -1e-3, "omega": 0.8}


def make_scene(
    seed: int, n: int, camera: Camera = CAMERA
) -> tuple[NDArray[np.float64], NDArray[np.float64], Pose]:
    """Exact pixels (n, 2), points (n, 3) and the pose that links them."""
    rng = np.random.default_rng(seed)
    pixels = rng.uniform([5, 5], [camera.width - 5, camera.height - 5], (n, 2))
    truth = Pose(
        Rotation.from_rotvec(rng.normal(size=3)).as_matrix(), rng.normal(size=3) * [2.0, 2.0, 1.0]
    )
    depth = rng.uniform(1.0, 6.0, (n, 1))
    points = truth.inverse().apply(normalized_rays(camera, pixels) * depth)
    return pixels, points, truth


@pytest.mark.parametrize("model", sorted(CAMERA_MODELS))
def test_exact_correspondences_give_the_exact_pose_for_every_camera_model(model: str) -> None:
    values = {"f": 500.0, "fx": 500.0, "fy": 505.0, "cx": 320.0, "cy": 240.0} | DISTORTION
    camera = Camera(model, 640, 480, tuple(values.get(p, 1e-4) for p in CAMERA_MODELS[model]))
    pixels, points, truth = make_scene(3, 60, camera)
    found = estimate_absolute_pose(pixels, points, camera, max_error_px=4.0, seed=0)
    assert found is not None
    distance, angle = pose_error(found.cam_from_world, truth)
    assert distance < 1e-6
    assert angle < 1e-5
    assert found.inliers.all()


def test_half_of_the_correspondences_may_be_wrong() -> None:
    pixels, points, truth = make_scene(1, 200)
    wrong = np.arange(200) % 2 == 0
    pixels[wrong] = np.random.default_rng(2).uniform(0, 480, (100, 2))
    found = estimate_absolute_pose(pixels, points, CAMERA, max_error_px=4.0, seed=0)
    assert found is not None
    assert pose_error(found.cam_from_world, truth)[0] < 1e-3
    assert found.inliers[~wrong].all()
    assert found.inliers[wrong].mean() < 0.1


def test_equal_seeds_give_equal_bits() -> None:
    pixels, points, _ = make_scene(4, 100)
    pixels[::3] += 40.0
    poses = [
        estimate_absolute_pose(pixels, points, CAMERA, max_error_px=4.0, seed=5) for _ in range(3)
    ]
    assert all(pose is not None for pose in poses)
    matrices = [p.cam_from_world.rotation.tobytes() for p in poses if p is not None]
    assert len(set(matrices)) == 1


@pytest.mark.parametrize("n", [0, 1, 2, 3])
def test_fewer_than_four_points_give_no_pose(n: int) -> None:
    pixels, points, _ = make_scene(0, n)
    assert estimate_absolute_pose(pixels, points, CAMERA, max_error_px=4.0, seed=0) is None


def test_points_behind_the_camera_are_not_inliers() -> None:
    pixels, points, truth = make_scene(0, 10)
    mirrored = truth.inverse().apply(-truth.apply(points))
    assert np.isnan(reprojection_errors(CAMERA, truth, pixels, mirrored)).all()


def test_collinear_points_leave_the_covariance_undetermined() -> None:
    truth = Pose.identity()
    points = np.column_stack([np.linspace(-1, 1, 20), np.zeros(20), np.full(20, 3.0)])
    pixels = project(CAMERA, points)
    assert pose_covariance(CAMERA, truth, pixels, points, LOSS_SCALE_PX) is None


@pytest.mark.parametrize("num_points", [30, 150])
@pytest.mark.parametrize(
    ("noise_px", "far_points_scatter_more"), [(0.3, False), (2.0, False), (0.3, True)]
)
def test_covariance_agrees_with_monte_carlo(
    num_points: int, noise_px: float, far_points_scatter_more: bool
) -> None:
    """The squared error, normalized by the stated covariance, is at most chi-square(6).

    At most: the wider of two estimates is stated, so that the mean of 200 trials, which is
    6 +- 0.25 when the statement is exact, comes out a little lower; lower still when the two
    disagree, because distant points scatter more.
    """
    rng = np.random.default_rng(7)
    normalized = []
    for trial in range(200):
        pixels, points, truth = make_scene(trial, num_points)
        depth = np.linalg.norm(truth.apply(points), axis=1)
        spread = noise_px * (depth**1.5 if far_points_scatter_more else np.ones_like(depth))
        noisy = pixels + rng.normal(size=pixels.shape) * spread[:, None]
        found = estimate_absolute_pose(noisy, points, CAMERA, max_error_px=30.0, seed=0)
        assert found is not None
        assert found.covariance is not None
        estimate = found.cam_from_world
        w = Rotation.from_matrix(truth.rotation @ estimate.rotation.T).as_rotvec()
        error = np.concatenate([w, truth.translation - estimate.translation])
        normalized.append(error @ np.linalg.solve(found.covariance, error))
    inside = np.mean(np.array(normalized) < chi2.ppf(0.95, 6))
    assert inside >= 0.92
    assert (3.0 if far_points_scatter_more else 4.5) <= np.mean(normalized) <= 6.6


def test_position_covariance_is_that_of_the_centre() -> None:
    rng = np.random.default_rng(0)
    _, _, pose = make_scene(9, 1)
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
    _, _, local = make_scene(9, 1)
    origin = np.array([500_000.0, 4_600_000.0, 120.0])
    covariance = np.diag([1e-6, 2e-6, 3e-6, 1e-4, 2e-4, 3e-4])
    world, moved = with_origin(local, covariance, origin)
    assert world.center == pytest.approx(local.center + origin, abs=1e-6)
    assert moved[:3, :3] == pytest.approx(covariance[:3, :3])
    assert position_covariance(world, moved) == pytest.approx(
        position_covariance(local, covariance), rel=1e-3, abs=1e-8
    )
