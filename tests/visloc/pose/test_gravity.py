from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from visloc.evaluation import pose_error
from visloc.geometry import Camera, Pose
from visloc.pose.generalized import GeneralizedPose, estimate_generalized_pose
from visloc.pose.gravity import KnownGravity, find_upright_poses, gravity_deviation
from visloc.pose.reprojection import MatchedView, normalized_rays

CAMERA = Camera("PINHOLE", 640, 480, (500.0, 510.0, 322.0, 239.0))
ALONE = [Pose.identity()]
PAIR = [
    Pose.identity(),
    Pose(Rotation.from_euler("y", 90, degrees=True).as_matrix(), np.array([0.2, 0.0, 0.3])),
]
PANORAMA = [Pose(camera.rotation, np.zeros(3)) for camera in PAIR]


def look(
    seed: int, cams_from_rig: list[Pose], n: int, num_right: int, noise_px: float = 0.5
) -> tuple[list[MatchedView], Pose]:
    """Views of n correspondences each, all but the last ``num_right`` shuffled."""
    rng = np.random.default_rng(seed)
    truth = Pose(Rotation.from_rotvec(rng.normal(size=3)).as_matrix(), rng.normal(size=3))
    views = []
    for cam_from_rig in cams_from_rig:
        pixels = rng.uniform([5, 5], [635, 475], (n, 2))
        seen = normalized_rays(CAMERA, pixels) * rng.uniform(2.0, 10.0, (n, 1))
        points = (cam_from_rig @ truth).inverse().apply(seen)
        points[: n - num_right] = np.roll(points[: n - num_right], 1, axis=0)
        pixels += rng.normal(size=pixels.shape) * noise_px
        views.append(MatchedView(CAMERA, cam_from_rig, pixels, points))
    return views, truth


def gravity_of(truth: Pose, seed: int, error_deg: float, std_deg: float = 1.0) -> KnownGravity:
    """Gravity in a random direction of the world; the rig's is off by an angle."""
    rng = np.random.default_rng(seed)
    world = rng.normal(size=3)
    world /= np.linalg.norm(world)
    down = truth.rotation @ world
    across = np.cross(down, rng.normal(size=3))
    across *= np.radians(error_deg) / np.linalg.norm(across)
    return KnownGravity(Rotation.from_rotvec(across).apply(down), world, np.radians(std_deg))


def assert_right(found: GeneralizedPose | None, truth: Pose) -> GeneralizedPose:
    assert found is not None
    distance, angle = pose_error(found.rig_from_world, truth)
    assert distance < 0.05
    assert angle < 0.3
    return found


@pytest.mark.parametrize("cams_from_rig", [ALONE, PAIR, PANORAMA])
@pytest.mark.parametrize("error_deg", [0.0, 1.0, 2.5])
def test_one_right_correspondence_in_ten_is_enough(
    cams_from_rig: list[Pose], error_deg: float
) -> None:
    for seed in range(3):
        n = 300 // len(cams_from_rig)
        views, truth = look(seed, cams_from_rig, n, n // 10)
        gravity = gravity_of(truth, seed, error_deg)
        found = estimate_generalized_pose(views, max_error_px=8.0, seed=seed, gravity=gravity)
        assert_right(found, truth)
        assert found is not None
        assert all(mask[n - n // 10 :].mean() > 0.9 for mask in found.inliers)
        deviation = gravity_deviation(found.rig_from_world, gravity)
        assert np.degrees(deviation) == pytest.approx(error_deg, abs=0.3)


def test_gravity_that_is_not_quite_right_does_not_bend_the_pose() -> None:
    views, truth = look(1, PAIR, 100, 80, noise_px=0.0)
    found = estimate_generalized_pose(
        views, max_error_px=8.0, seed=0, gravity=gravity_of(truth, 1, 1.0)
    )
    assert found is not None
    distance, angle = pose_error(found.rig_from_world, truth)
    assert distance < 1e-3
    assert angle < 1e-2


@pytest.mark.parametrize("cams_from_rig", [ALONE, PAIR])
@pytest.mark.parametrize("share_right", [0.1, 0.5])
def test_wrong_gravity_never_gives_a_pose_that_obeys_it_and_explains_much(
    cams_from_rig: list[Pose], share_right: float
) -> None:
    for seed in range(3):
        n = 200 // len(cams_from_rig)
        views, truth = look(seed, cams_from_rig, n, int(n * share_right))
        gravity = gravity_of(truth, seed, 30.0)
        found = estimate_generalized_pose(views, max_error_px=8.0, seed=seed, gravity=gravity)
        if found is not None and gravity_deviation(found.rig_from_world, gravity) < 0.1:
            assert found.num_inliers < 0.08 * 200


def test_a_vague_gravity_still_helps() -> None:
    views, truth = look(2, ALONE, 300, 60)
    gravity = gravity_of(truth, 2, 5.0, std_deg=5.0)
    found = estimate_generalized_pose(views, max_error_px=8.0, seed=0, gravity=gravity)
    assert_right(found, truth)


@pytest.mark.parametrize("down", [[0.0, 1, 0], [0.0, -1, 0], [1.0, 0, 0], [0.0, 0, 1]])
def test_gravity_may_point_along_any_axis(down: list[float]) -> None:
    views, truth = look(3, PAIR, 60, 60)
    gravity = KnownGravity(np.array(down), truth.rotation.T @ down, np.radians(0.5))
    found = estimate_generalized_pose(views, max_error_px=8.0, seed=0, gravity=gravity)
    assert assert_right(found, truth).num_inliers == 120


def test_equal_seeds_give_equal_bits() -> None:
    views, truth = look(4, PAIR, 400, 80)  # more than are scored
    gravity = gravity_of(truth, 4, 1.0)
    bits = set()
    for _ in range(3):
        found = estimate_generalized_pose(views, max_error_px=8.0, seed=9, gravity=gravity)
        bits.add(assert_right(found, truth).rig_from_world.rotation.tobytes())
    assert len(bits) == 1


@pytest.mark.parametrize("n", [0, 1, 3])
def test_fewer_than_four_points_give_no_pose(n: int) -> None:
    views, truth = look(0, ALONE, n, n)
    gravity = gravity_of(truth, 0, 0.0)
    assert estimate_generalized_pose(views, max_error_px=8.0, seed=0, gravity=gravity) is None


def test_numbers_that_are_not_finite_are_left_out() -> None:
    views, truth = look(5, PAIR, 60, 60)
    views[0].pixels[:30] = np.nan
    views[1].points[:30] = np.inf
    gravity = gravity_of(truth, 5, 0.0)
    found = estimate_generalized_pose(views, max_error_px=8.0, seed=0, gravity=gravity)
    assert assert_right(found, truth).num_inliers == 60
    views = [replace(view, pixels=np.full((60, 2), np.nan)) for view in views]
    assert find_upright_poses(views, gravity, max_error_px=8.0, seed=0) == []


def test_points_in_one_spot_give_no_pose() -> None:
    (view,), truth = look(6, ALONE, 20, 20)
    spot = replace(view, pixels=np.full((20, 2), 100.0), points=np.ones((20, 3)))
    gravity = gravity_of(truth, 6, 0.0)
    assert estimate_generalized_pose([spot], max_error_px=8.0, seed=0, gravity=gravity) is None


def test_deviation_is_the_angle_between_both_downs() -> None:
    _, truth = look(7, ALONE, 1, 1)
    for error_deg in (0.0, 1e-4, 30.0, 180.0):
        deviation = gravity_deviation(truth, gravity_of(truth, 7, error_deg))
        assert np.degrees(deviation) == pytest.approx(error_deg, abs=1e-6)
