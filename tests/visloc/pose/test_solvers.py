from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from visloc.errors import InvalidInput
from visloc.evaluation import pose_error
from visloc.geometry import CAMERA_MODELS, Camera, Pose, center_covariance
from visloc.localization.solving import SeenImage, Solved, solve_instant
from visloc.options import LocalizeOptions, Solver
from visloc.pose.generalized import (
    SOLVERS,
    GeneralizedPose,
    estimate_generalized_pose,
    refine_generalized_pose,
)
from visloc.pose.motion import MapErrors
from visloc.pose.reprojection import MatchedView, normalized_rays
from visloc.priors import GravityPrior, Priors
from visloc.types import CameraSource, Reason

CAMERA = Camera("PINHOLE", 640, 480, (500.0, 510.0, 322.0, 239.0))
GUESS = Camera("SIMPLE_PINHOLE", 640, 480, (768.0, 320.0, 240.0))
DISTORTION = {"k": 0.02, "k1": 0.03, "k2": -0.01, "p1": 1e-3, "p2": -1e-3, "omega": 0.8}
FOR_RIGS = [Solver.PYCOLMAP, Solver.POSELIB]
CHI2_6_95 = 12.59


def model_camera(model: str) -> Camera:
    values = {"f": 500.0, "fx": 500.0, "fy": 505.0, "cx": 320.0, "cy": 240.0} | DISTORTION
    return Camera(model, 640, 480, tuple(values.get(p, 1e-4) for p in CAMERA_MODELS[model]))


def turned(degrees: float) -> Pose:
    rotation = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    return Pose(rotation, np.array([0.1, -0.05, -0.3]))


def look(
    seed: int,
    cams_from_rig: list[Pose],
    count: int,
    camera: Camera = CAMERA,
    num_wrong: int = 0,
    noise_px: float = 0.0,
    depths: tuple[float, float] = (1.0, 8.0),
    tilt_deg: float | None = None,
) -> tuple[list[MatchedView], Pose]:
    """Views of points between two depths, or in a plane 5 ahead that is tilted, and the pose."""
    rng = np.random.default_rng(seed)
    truth = Pose(Rotation.from_rotvec(rng.normal(size=3)).as_matrix(), rng.normal(size=3) * 2.0)
    views = []
    for cam_from_rig in cams_from_rig:
        pixels = rng.uniform(5, [camera.width - 5, camera.height - 5], (count, 2))
        rays = normalized_rays(camera, pixels)
        depth = rng.uniform(*depths, count)
        if tilt_deg is not None:
            depth = 5.0 / (1.0 + np.tan(np.radians(tilt_deg)) * rays[:, 0])
        points = (cam_from_rig @ truth).inverse().apply(rays * depth[:, None])
        points[:num_wrong] = np.roll(points[:num_wrong], 1, axis=0)
        pixels += rng.normal(size=pixels.shape) * noise_px
        views.append(MatchedView(camera, cam_from_rig, pixels, points))
    return views, truth


def solve(views: list[MatchedView], solver: Solver, seed: int = 0) -> GeneralizedPose | None:
    return estimate_generalized_pose(views, max_error_px=12.0, seed=seed, solver=solver)


def assert_near(found: GeneralizedPose | None, truth: Pose, limit: float = 1e-5) -> None:
    assert found is not None
    distance, degrees = pose_error(found.rig_from_world, truth)
    assert distance < limit
    assert degrees < 100 * limit
    assert found.covariance is not None


def test_every_solver_has_its_function() -> None:
    assert set(SOLVERS) == set(Solver)


@pytest.mark.parametrize("solver", Solver)
@pytest.mark.parametrize("model", sorted(CAMERA_MODELS))
def test_a_camera_of_every_model_gives_the_exact_pose(model: str, solver: Solver) -> None:
    views, truth = look(3, [Pose.identity()], 80, model_camera(model), num_wrong=30)
    found = solve(views, solver)
    assert_near(found, truth)
    assert found is not None
    assert found.inliers[0][30:].all()


@pytest.mark.parametrize("solver", FOR_RIGS)
def test_a_rig_gives_the_exact_pose(solver: Solver) -> None:
    rig = [turned(angle) for angle in (0.0, 90.0, 180.0, 270.0)]
    views, truth = look(4, rig, 30, num_wrong=10)
    nothing = views[1].selected(np.empty(0, np.intp))
    assert_near(solve(views, solver), truth)
    assert_near(solve([views[0], nothing, views[2]], solver), truth)


@pytest.mark.parametrize("solver", Solver)
def test_one_camera_of_a_rig_gives_the_pose_of_the_rig(solver: Solver) -> None:
    views, truth = look(5, [turned(70.0)], 60, num_wrong=20)
    assert_near(solve(views, solver), truth)


@pytest.mark.parametrize("solver", Solver)
def test_pixels_and_points_that_are_no_numbers_do_not_matter(solver: Solver) -> None:
    (view,), truth = look(6, [Pose.identity()], 60)
    view.pixels[3], view.pixels[5, 0], view.points[7, 1] = np.nan, np.inf, -np.inf
    found = solve([view], solver)
    assert_near(found, truth)
    assert found is not None
    assert np.flatnonzero(~found.inliers[0]).tolist() == [3, 5, 7]


@pytest.mark.parametrize("solver", Solver)
@pytest.mark.parametrize("count", [0, 1, 3])
def test_fewer_than_four_correspondences_give_nothing(count: int, solver: Solver) -> None:
    views, _ = look(7, [Pose.identity()], count)
    assert solve(views, solver) is None
    assert (
        solve([replace(view, camera=GUESS, focal_unknown=True) for view in views], solver) is None
    )


@pytest.mark.parametrize("solver", Solver)
def test_correspondences_that_are_all_wrong_have_few_inliers(solver: Solver) -> None:
    views, _ = look(8, [Pose.identity()], 200, num_wrong=200)
    found = solve(views, solver)
    assert found is None or found.num_inliers < 30


@pytest.mark.parametrize(
    ("solver", "num_cameras"),
    [*((solver, 1) for solver in Solver), *((solver, 3) for solver in FOR_RIGS)],
)
def test_equal_seeds_give_equal_bits(solver: Solver, num_cameras: int) -> None:
    rig = [turned(120.0 * i) for i in range(num_cameras)]
    views, _ = look(9, rig, 200, num_wrong=120, noise_px=2.0)
    found = [solve(views, solver, seed=5) for _ in range(8)]
    bits = {
        pose.rig_from_world.translation.tobytes() + pose.covariance.tobytes()
        for pose in found
        if pose is not None and pose.covariance is not None
    }
    assert len(bits) == 1


def test_both_solvers_find_the_same_pose() -> None:
    views, truth = look(10, [Pose.identity()], 400, num_wrong=200, noise_px=1.0)
    a, b = solve(views, Solver.PYCOLMAP), solve(views, Solver.POSELIB)
    assert a is not None
    assert b is not None
    assert_near(a, truth, 0.02)
    assert pose_error(a.rig_from_world, b.rig_from_world)[0] < 1e-3


def test_registration_refines_with_its_own_loss_and_keeps_the_inliers_of_its_search() -> None:
    (view,), _ = look(11, [Pose.identity()], 300, num_wrong=100, noise_px=3.0)
    found = solve([view], Solver.REGISTRATION, seed=4)
    options = {"ransac": {"max_error": 12.0, "random_seed": 4}}
    camera = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=list(CAMERA.params))
    expected = pycolmap.estimate_and_refine_absolute_pose(view.pixels, view.points, camera, options)
    assert found is not None
    assert expected is not None
    assert np.array_equal(found.inliers[0], expected["inlier_mask"])
    assert found.rig_from_world.translation == pytest.approx(
        expected["cam_from_world"].translation, abs=1e-12
    )


# An unknown focal length


def without_focal(views: list[MatchedView]) -> list[MatchedView]:
    return [replace(view, camera=GUESS, focal_unknown=True) for view in views]


def true_camera(focal: float) -> Camera:
    return Camera("SIMPLE_PINHOLE", 640, 480, (focal, 320.0, 240.0))


@pytest.mark.parametrize("focal", [200.0, 500.0, 1100.0, 4000.0])
def test_an_unknown_focal_length_is_found_with_the_pose(focal: float) -> None:
    views, truth = look(12, [turned(30.0)], 200, true_camera(focal), num_wrong=80)
    found = solve(without_focal(views), Solver.POSELIB)
    assert_near(found, truth)
    assert found is not None
    assert found.camera is not None
    assert found.camera.params == pytest.approx((focal, 320.0, 240.0), rel=1e-6)


@pytest.mark.parametrize("focal", [400.0, 700.0, 1500.0])
def test_a_tilted_plane_tells_the_focal_length(focal: float) -> None:
    camera = true_camera(focal)
    views, truth = look(13, [Pose.identity()], 200, camera, noise_px=0.3, tilt_deg=40.0)
    found = solve(without_focal(views), Solver.PYCOLMAP)
    assert_near(found, truth, 0.1)
    assert found is not None
    assert found.camera is not None
    assert found.camera.focal_length == pytest.approx(focal, rel=0.02)


@pytest.mark.parametrize("tilt_deg", [0.0, 3.0, 6.0])
def test_a_plane_parallel_to_the_image_leaves_the_pose_undetermined(tilt_deg: float) -> None:
    camera = true_camera(600.0)
    for seed in range(3):
        views, _ = look(seed, [Pose.identity()], 300, camera, noise_px=1.5, tilt_deg=tilt_deg)
        found = solve(without_focal(views), Solver.PYCOLMAP)
        assert found is None or found.covariance is None


def test_nearly_parallel_to_the_image_the_lowest_loss_is_found_all_the_same() -> None:
    """Steps that end sooner leave the focal length a dozen standard deviations off."""
    for seed in range(3):
        camera = true_camera(600.0)
        views, _ = look(200 + seed, [Pose.identity()], 200, camera, noise_px=0.5, tilt_deg=6.0)
        found = solve(without_focal(views), Solver.PYCOLMAP)
        assert found is not None
        assert found.camera is not None
        again = refine_generalized_pose(
            [replace(views[0], camera=found.camera, focal_unknown=True)],
            found.rig_from_world,
            max_error_px=12.0,
        )
        assert again is not None
        assert again.camera is not None
        assert again.camera.focal_length == pytest.approx(found.camera.focal_length, rel=1e-3)


@pytest.mark.parametrize("focal", [90.0, 8000.0])
def test_a_focal_length_that_no_camera_has_gives_nothing(focal: float) -> None:
    views, _ = look(14, [Pose.identity()], 200, true_camera(focal))
    found = solve(without_focal(views), Solver.PYCOLMAP)
    assert found is None or found.num_inliers < 100


@pytest.mark.parametrize(
    ("depths", "tilt_deg"), [((3.0, 8.0), None), ((4.5, 5.5), None), ((5.0, 5.0), 20.0)]
)
def test_the_covariance_holds_what_the_focal_length_leaves_open(
    depths: tuple[float, float], tilt_deg: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The principal point is exact here: without the part for one that is not."""
    monkeypatch.setattr("visloc.pose.covariance._PRINCIPAL_POINT_STD", 0.0)
    inside, wide = [], []
    for seed in range(40):
        views, truth = look(
            100 + seed,
            [Pose.identity()],
            100,
            true_camera(600.0),
            noise_px=1.5,
            depths=depths,
            tilt_deg=tilt_deg,
        )
        found = solve(without_focal(views), Solver.PYCOLMAP)
        known = solve(views, Solver.PYCOLMAP)
        assert found is not None
        assert found.covariance is not None
        assert known is not None
        assert known.covariance is not None
        w = Rotation.from_matrix(found.rig_from_world.rotation @ truth.rotation.T).as_rotvec()
        error = np.concatenate([w, found.rig_from_world.center - truth.center])
        covariance = center_covariance(found.rig_from_world, found.covariance)
        inside.append(error @ np.linalg.solve(covariance, error) < CHI2_6_95)
        wide.append(np.trace(found.covariance[3:, 3:]) > np.trace(known.covariance[3:, 3:]))
    assert 0.8 <= np.mean(inside) <= 1.0
    assert np.mean(wide) > 0.9


@pytest.mark.parametrize(
    ("focal", "noise_px", "tilt_deg"), [(600.0, 3.0, None), (300.0, 1.0, 40.0)]
)
def test_the_covariance_holds_a_principal_point_off_the_centre(
    focal: float, noise_px: float, tilt_deg: float | None
) -> None:
    """By one per cent of the longer side, and all six degrees of freedom together."""
    normalized = []
    for seed in range(40):
        shift = np.random.default_rng(seed).normal(size=2) * 6.4
        camera = Camera("SIMPLE_PINHOLE", 640, 480, (focal, 320.0 + shift[0], 240.0 + shift[1]))
        views, truth = look(
            200 + seed, [Pose.identity()], 150, camera, noise_px=noise_px, tilt_deg=tilt_deg
        )
        found = solve(without_focal(views), Solver.PYCOLMAP)
        assert found is not None
        assert found.covariance is not None
        w = Rotation.from_matrix(found.rig_from_world.rotation @ truth.rotation.T).as_rotvec()
        error = np.concatenate([w, found.rig_from_world.center - truth.center])
        covariance = center_covariance(found.rig_from_world, found.covariance)
        normalized.append(error @ np.linalg.solve(covariance, error))
    assert np.mean(np.array(normalized) < CHI2_6_95) >= 0.85
    assert 3.5 < np.mean(normalized) < 7.5


def test_no_map_widens_the_doubt_in_the_principal_point() -> None:
    """Exact matches leave nothing else open, so a bad map makes the pose no less sure."""
    views, _ = look(300, [Pose.identity()], 150, true_camera(600.0), noise_px=0.0)
    found = solve(without_focal(views), Solver.PYCOLMAP)
    assert found is not None
    assert found.covariance is not None
    assert found.of_camera is not None
    bad = MapErrors(20.0, 20.0)

    whole = bad.whole(found.rig_from_world, found.covariance, found.of_camera)

    np.testing.assert_allclose(whole, found.covariance, rtol=1e-3, atol=1e-12)
    # 6.4 of 600 pixels, which a turn of the camera hides.
    assert np.degrees(np.sqrt(np.diag(whole)[:2])) == pytest.approx([0.6, 0.6], abs=0.15)
    known = solve(views, Solver.PYCOLMAP)
    assert known is not None
    assert known.of_camera is None


# In an answer


def guessed(image: SeenImage) -> SeenImage:
    """The image with a camera that is a guess."""
    assert image.look is not None
    evidence = replace(image.look.evidence, camera=GUESS, camera_source=CameraSource.GUESS)
    return replace(image, look=replace(image.look, evidence=evidence))


def answer(
    place: Any, image: SeenImage, source: CameraSource = CameraSource.GUESS, **options: Any
) -> Solved:
    """To one photo with a camera that is given, or a guess."""
    image = guessed(image) if source is CameraSource.GUESS else image
    priors = options.pop("priors", Priors())
    return solve_instant([image], place.geometry, LocalizeOptions(**options), priors)


POSE = Pose(Rotation.from_rotvec([0.3, -1.2, 0.4]).as_matrix(), np.array([1.0, -2.0, 0.5]))


@pytest.mark.parametrize("solver", FOR_RIGS)
def test_a_guessed_camera_comes_back_estimated(place: Any, solver: Solver) -> None:
    image = place.image(place.matches(POSE, 150, 60, seed=1, noise=0.5))
    solved = answer(place, image, solver=solver)
    evidence = solved.answer.images[0].evidence
    assert solved.answer.pose is not None
    assert evidence is not None
    assert evidence.camera_source is CameraSource.ESTIMATED
    true = image.look.evidence.camera
    assert evidence.camera.focal_length == pytest.approx(true.focal_length, rel=0.02)
    assert evidence.num_inliers == solved.answer.num_inliers >= 150
    assert solved.views[0].camera == evidence.camera
    assert solved.views[0].focal_unknown


def test_a_refused_photo_keeps_its_guess(place: Any) -> None:
    """Sixty inliers are sure with a camera, and not without."""
    image = place.image(place.matches(POSE, 60, 40, seed=2, noise=0.5))
    assert answer(place, image, CameraSource.GIVEN).answer.pose is not None
    solved = answer(place, image)
    evidence = solved.answer.images[0].evidence
    assert solved.answer.refusal is not None
    assert solved.answer.refusal.reason is Reason.UNCERTAIN_POSE
    assert "send the camera" in solved.answer.refusal.message
    assert evidence is not None
    assert (evidence.camera, evidence.camera_source) == (GUESS, CameraSource.GUESS)


@pytest.mark.parametrize("preset", ["default", "config1", "config2"])
def test_registration_refuses_a_guess(place: Any, preset: str) -> None:
    image = place.image(place.matches(POSE, 150, 20, seed=3, noise=0.5))
    solved = answer(place, image, solver=Solver.REGISTRATION, preset=preset)
    assert_needs_camera(solved)
    # One that shows nothing has another reason.
    nothing = place.image(place.matches(POSE, 3, 0))
    refusal = answer(place, nothing, solver=Solver.REGISTRATION, preset=preset).answer.refusal
    assert refusal is not None
    assert refusal.reason is Reason.TOO_FEW_MATCHES


def assert_needs_camera(solved: Solved) -> None:
    refusal = solved.answer.refusal
    assert solved.answer.pose is None
    assert refusal is not None
    assert (refusal.stage, refusal.reason) == ("gate", Reason.UNCERTAIN_POSE)
    assert "send the camera" in refusal.message


def rig_of(place: Any, count: int) -> list[SeenImage]:
    rig = [turned(100.0 * i) for i in range(count)]
    return [
        place.image(
            place.matches(cam_from_rig @ POSE, 150, 20, seed=i, noise=0.5),
            sensor=f"cam{i}",
            cam_from_rig=cam_from_rig,
        )
        for i, cam_from_rig in enumerate(rig)
    ]


def test_of_a_rig_images_whose_camera_is_a_guess_are_left_out(place: Any) -> None:
    first, second, third = rig_of(place, 3)
    options, priors = LocalizeOptions(), Priors()
    without = solve_instant([first, third], place.geometry, options, priors)
    solved = solve_instant([first, guessed(second), third], place.geometry, options, priors)
    assert solved.pose is not None
    assert without.pose is not None
    assert solved.pose.covariance is not None
    assert np.array_equal(
        solved.pose.rig_from_world.translation, without.pose.rig_from_world.translation
    )
    assert [len(view) for view in solved.views] == [170, 0, 170]
    evidence = solved.answer.images[1].evidence
    assert evidence is not None
    assert (evidence.camera_source, evidence.num_inliers) == (CameraSource.GUESS, 0)


def test_a_rig_of_guesses_is_refused_unless_one_image_is_all_there_is(place: Any) -> None:
    images = [guessed(image) for image in rig_of(place, 2)]
    options, priors = LocalizeOptions(), Priors()
    assert_needs_camera(solve_instant(images, place.geometry, options, priors))
    broken = place.image(None, sensor="cam0")
    solved = solve_instant([broken, images[1]], place.geometry, options, priors)
    assert solved.pose is not None
    assert pose_error(solved.pose.rig_from_world, POSE) < (0.1, 1.0)


@pytest.mark.parametrize("preset", ["config1", "config2"])
def test_registration_has_the_thresholds_of_the_preset(place: Any, preset: str) -> None:
    """Twenty inliers: ten more are asked for in config1, four are enough for config2."""
    image = place.image(place.matches(POSE, 20, 0, seed=4, noise=0.5))
    solved = answer(place, image, CameraSource.GIVEN, preset=preset, solver=Solver.REGISTRATION)
    assert (solved.answer.pose is not None) == (preset == "config2")


def test_registration_refuses_a_rig(place: Any) -> None:
    image = place.image(place.matches(POSE, 50, 0, seed=5))
    options = LocalizeOptions(solver=Solver.REGISTRATION)
    with pytest.raises(InvalidInput) as caught:
        solve_instant([image, image], place.geometry, options, Priors())
    assert caught.value.code == "options.solver"


@pytest.mark.parametrize("solver", Solver)
def test_known_gravity_is_searched_with_whatever_the_solver(place: Any, solver: Solver) -> None:
    down = np.array([0.0, 0.0, -1.0])
    upright = replace(place, down=down)
    priors = Priors(gravity=GravityPrior(POSE.rotation @ down, np.radians(2.0)))
    for source in (CameraSource.GIVEN, CameraSource.GUESS):
        image = upright.image(upright.matches(POSE, 150, 100, seed=6, noise=0.5))
        solved = answer(upright, image, source, solver=solver, priors=priors)
        registers = solver is Solver.REGISTRATION and source is CameraSource.GUESS
        assert (solved.answer.pose is None) == registers


def test_gravity_that_took_no_part_is_not_searched_without_again(
    hall: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beside a focal length to find."""
    calls = []

    def counted(views: Any, **options: Any) -> GeneralizedPose | None:
        if len(views[0]) == 550:  # else other draws of those near the pose
            calls.append(options)
        return estimate_generalized_pose(views, **options)

    monkeypatch.setattr("visloc.localization.acceptance.gates.estimate_generalized_pose", counted)
    image = hall.image(hall.matches(POSE, 150, 400, seed=7))
    priors = Priors(gravity=GravityPrior(POSE.rotation @ hall.down, np.radians(2.0)))
    for source, expected in ((CameraSource.GIVEN, 2), (CameraSource.GUESS, 1)):
        calls.clear()
        assert answer(hall, image, source, priors=priors).answer.pose is not None
        assert len(calls) == expected
