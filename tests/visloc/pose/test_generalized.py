from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from visloc.evaluation import pose_error
from visloc.geometry import CAMERA_MODELS, Camera, Pose
from visloc.pose.generalized import estimate_generalized_pose, refine_generalized_pose
from visloc.pose.reprojection import MatchedView, normalized_rays, reprojection_errors

CAMERA = Camera("PINHOLE", 640, 480, (500.0, 510.0, 322.0, 239.0))
DISTORTION = {"k": 0.02, "k1": 0.03, "k2": -0.01, "p1": 1e-3, "p2": -1e-3, "omega": 0.8}


def model_camera(model: str) -> Camera:
    values = {"f": 500.0, "fx": 500.0, "fy": 505.0, "cx": 320.0, "cy": 240.0} | DISTORTION
    return Camera(model, 640, 480, tuple(values.get(p, 1e-4) for p in CAMERA_MODELS[model]))


def turned(degrees: float, *translation: float) -> Pose:
    rotation = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    return Pose(rotation, np.array(translation or (0.0, 0.0, 0.0)))


# Four cameras that look away from each other; no two see the same.
SURROUND = [turned(angle, 0.1, -0.05, -0.3) for angle in (0.0, 90.0, 180.0, 270.0)]
ALONE = [Pose.identity()]


def look(
    seed: int,
    cams_from_rig: Sequence[Pose],
    counts: Sequence[int],
    cameras: Sequence[Camera] = (CAMERA,),
    num_wrong: int = 0,
) -> tuple[list[MatchedView], Pose]:
    """Exact correspondences, the first ``num_wrong`` of each camera shuffled, and the pose."""
    rng = np.random.default_rng(seed)
    truth = Pose(Rotation.from_rotvec(rng.normal(size=3)).as_matrix(), rng.normal(size=3) * 2.0)
    views = []
    for index, (cam_from_rig, n) in enumerate(zip(cams_from_rig, counts, strict=True)):
        camera = cameras[index % len(cameras)]
        pixels = rng.uniform(5, [camera.width - 5, camera.height - 5], (n, 2))
        seen = normalized_rays(camera, pixels) * rng.uniform(1.0, 8.0, (n, 1))
        points = (cam_from_rig @ truth).inverse().apply(seen)
        points[:num_wrong] = np.roll(points[:num_wrong], 1, axis=0)
        views.append(MatchedView(camera, cam_from_rig, pixels, points))
    return views, truth


def with_noise(views: Sequence[MatchedView], seed: int, noise_px: float) -> list[MatchedView]:
    rng = np.random.default_rng(seed)
    return [replace(v, pixels=v.pixels + rng.normal(size=v.pixels.shape) * noise_px) for v in views]


def assert_exact(views: Sequence[MatchedView], truth: Pose) -> None:
    found = estimate_generalized_pose(views, max_error_px=4.0, seed=0)
    assert found is not None
    distance, angle = pose_error(found.rig_from_world, truth)
    assert distance < 1e-6
    assert angle < 1e-5
    assert [len(mask) for mask in found.inliers] == [len(view) for view in views]
    assert found.num_inliers == sum(len(view) for view in views)
    assert found.covariance is not None


@pytest.mark.parametrize("model", sorted(CAMERA_MODELS))
def test_one_camera_of_every_model_gives_the_exact_pose(model: str) -> None:
    assert_exact(*look(3, ALONE, [60], [model_camera(model)]))


def test_cameras_of_different_models_and_sizes_give_the_exact_pose_of_the_rig() -> None:
    large = Camera("SIMPLE_RADIAL", 2560, 1920, (2400.0, 1280.0, 960.0, 0.05))
    cameras = [model_camera("OPENCV"), model_camera("OPENCV_FISHEYE"), large, CAMERA]
    assert_exact(*look(4, SURROUND, [30, 40, 50, 20], cameras))


def test_three_points_in_each_camera_are_enough() -> None:
    assert_exact(*look(5, SURROUND, [3, 3, 3, 3]))


def test_a_rig_localizes_where_no_camera_alone_can() -> None:
    """Five points each under noise, and as many wrong ones."""
    views, truth = look(6, SURROUND, [10, 10, 10, 10], num_wrong=5)
    views = with_noise(views, 6, 0.5)
    found = estimate_generalized_pose(views, max_error_px=4.0, seed=0)
    assert found is not None
    distance, angle = pose_error(found.rig_from_world, truth)
    assert distance < 0.01
    assert angle < 0.15
    assert all(mask[5:].all() and mask[:5].sum() <= 1 for mask in found.inliers)


def test_cameras_of_one_centre_are_a_rig_too() -> None:
    panorama = [turned(angle) for angle in (0.0, 120.0, 240.0)]
    assert_exact(*look(7, panorama, [12, 12, 12]))


def test_cameras_without_correspondences_do_not_matter() -> None:
    views, truth = look(8, SURROUND, [0, 20, 0, 20])
    assert_exact(views, truth)
    some, _ = look(8, [SURROUND[1], SURROUND[3]], [20, 20])
    all_of_them = estimate_generalized_pose(views, max_error_px=4.0, seed=0)
    without = estimate_generalized_pose(some, max_error_px=4.0, seed=0)
    assert all_of_them is not None
    assert without is not None
    assert pose_error(all_of_them.rig_from_world, without.rig_from_world)[0] < 1e-6


def test_one_camera_of_a_rig_gives_the_pose_of_the_rig() -> None:
    assert_exact(*look(9, SURROUND, [0, 0, 40, 0]))


@pytest.mark.parametrize(("cams_from_rig", "n"), [(ALONE, 300), (SURROUND, 75)])
@pytest.mark.parametrize("share_wrong", [0.5, 0.88])
def test_most_correspondences_may_be_wrong(
    cams_from_rig: list[Pose], n: int, share_wrong: float
) -> None:
    counts = [n] * len(cams_from_rig)
    num_wrong = int(n * share_wrong)
    views, truth = look(10, cams_from_rig, counts, num_wrong=num_wrong)
    views = with_noise(views, 10, 0.5)
    found = estimate_generalized_pose(views, max_error_px=8.0, seed=0)
    assert found is not None
    distance, angle = pose_error(found.rig_from_world, truth)
    assert distance < 0.02
    assert angle < 0.2
    assert all(mask[num_wrong:].all() for mask in found.inliers)
    assert all(mask[:num_wrong].mean() < 0.05 for mask in found.inliers)


@pytest.mark.parametrize("cams_from_rig", [ALONE, SURROUND])
@pytest.mark.parametrize(
    ("share_wrong", "order"), [(0.92, "random"), (0.92, "best first"), (0.8, "worst first")]
)
def test_a_pose_is_found_among_thousands_of_correspondences_in_any_order(
    cams_from_rig: list[Pose], share_wrong: float, order: str
) -> None:
    """Of which RANSAC looks at a sample."""
    n = 4000 // len(cams_from_rig)
    num_wrong = int(n * share_wrong)
    views, truth = look(18, cams_from_rig, [n] * len(cams_from_rig), num_wrong=num_wrong)
    views = with_noise(views, 18, 0.5)
    rows = np.arange(n)
    if order == "best first":
        rows = rows[::-1]
    elif order == "random":
        rows = np.random.default_rng(18).permutation(n)
    found = estimate_generalized_pose([v.selected(rows) for v in views], max_error_px=8.0, seed=0)
    assert found is not None
    distance, angle = pose_error(found.rig_from_world, truth)
    assert distance < 0.02
    assert angle < 0.2
    assert all(mask[rows >= num_wrong].all() for mask in found.inliers)


@pytest.mark.parametrize("cams_from_rig", [ALONE, SURROUND])
def test_equal_seeds_give_equal_bits(cams_from_rig: list[Pose]) -> None:
    views, _ = look(11, cams_from_rig, [60] * len(cams_from_rig), num_wrong=30)
    bits = set()
    for _ in range(3):
        found = estimate_generalized_pose(views, max_error_px=4.0, seed=5)
        assert found is not None
        bits.add(found.rig_from_world.rotation.tobytes())
    assert len(bits) == 1


@pytest.mark.parametrize("counts", [[0, 0, 0, 0], [1, 1, 1, 0], [3, 0, 0, 0]])
def test_fewer_than_four_points_give_no_pose(counts: list[int]) -> None:
    views, truth = look(0, SURROUND, counts)
    assert estimate_generalized_pose(views, max_error_px=4.0, seed=0) is None
    assert refine_generalized_pose(views, truth, max_error_px=4.0) is None


def test_no_camera_gives_no_pose() -> None:
    assert estimate_generalized_pose([], max_error_px=4.0, seed=0) is None


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_numbers_that_are_not_finite_are_no_inliers(bad: float) -> None:
    views, truth = look(12, SURROUND, [20] * 4)
    views[0].pixels[0, 1] = bad
    views[1].points[:] = bad
    found = estimate_generalized_pose(views, max_error_px=4.0, seed=0)
    assert found is not None
    assert pose_error(found.rig_from_world, truth)[0] < 1e-6
    assert not found.inliers[0][0]
    assert not found.inliers[1].any()
    assert found.num_inliers == 59
    for view in views:
        view.pixels[:] = bad
    assert estimate_generalized_pose(views, max_error_px=4.0, seed=0) is None


def test_points_in_one_spot_give_no_pose() -> None:
    views, _ = look(13, ALONE, [20])
    views[0].points[:] = 1.0
    assert estimate_generalized_pose(views, max_error_px=4.0, seed=0) is None


def test_as_many_pixels_as_points_are_expected_in_every_view() -> None:
    views, truth = look(14, SURROUND, [20] * 4)
    views[1] = replace(views[1], pixels=views[1].pixels[:-1])
    views[2] = replace(views[2], points=views[2].points[:-1])  # the same in all
    with pytest.raises(ValueError, match=r"views\[1\].*\(19, 2\) and \(20, 3\)"):
        estimate_generalized_pose(views, max_error_px=4.0, seed=0)
    with pytest.raises(ValueError, match=r"views\[1\]"):
        refine_generalized_pose(views, truth, max_error_px=4.0)


def test_points_behind_the_camera_are_not_inliers() -> None:
    (view,), truth = look(0, ALONE, [10])
    mirrored = truth.inverse().apply(-truth.apply(view.points))
    assert np.isnan(reprojection_errors(replace(view, points=mirrored), truth)).all()


def moved(pose: Pose, degrees: float, step: float) -> Pose:
    turn = Rotation.from_rotvec(np.radians(degrees) * np.array([0.6, 0.0, 0.8])).as_matrix()
    return Pose(turn @ pose.rotation, pose.translation + step)


def test_refinement_finds_the_inliers_that_the_start_had_missed() -> None:
    views, truth = look(15, SURROUND, [50] * 4)
    start = moved(truth, 0.5, 0.02)
    missed = sum(int((reprojection_errors(view, start) > 8.0).sum()) for view in views)
    assert 40 < missed < 160
    found = refine_generalized_pose(views, start, max_error_px=8.0)
    assert found is not None
    assert found.num_inliers == 200
    assert pose_error(found.rig_from_world, truth)[0] < 1e-6


def test_refinement_from_a_pose_that_explains_nothing_gives_none() -> None:
    views, truth = look(16, SURROUND, [20] * 4)
    assert refine_generalized_pose(views, moved(truth, 90.0, 3.0), max_error_px=4.0) is None


def test_inliers_are_those_of_the_refined_pose_in_each_cameras_own_pixels() -> None:
    """The camera of 8 times the focal length does not lend its threshold to the other."""
    large = Camera("PINHOLE", 5120, 3840, (4000.0, 4000.0, 2560.0, 1920.0))
    views, truth = look(17, SURROUND[:2], [60, 60], [CAMERA, large])
    shift = np.linspace(5.0, 20.0, 10)
    for view in views:
        view.pixels[:10, 0] += shift
    found = estimate_generalized_pose(views, max_error_px=12.0, seed=0)
    assert found is not None
    assert pose_error(found.rig_from_world, truth)[0] < 0.01
    for view, mask in zip(views, found.inliers, strict=True):
        errors: NDArray[np.float64] = reprojection_errors(view, found.rig_from_world)
        assert np.array_equal(mask, errors <= 12.0)
        assert 2 <= mask[:10].sum() <= 7
