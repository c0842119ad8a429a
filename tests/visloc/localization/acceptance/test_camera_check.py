"""A camera that is wrong is told so, and by how much; one that is right never is."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from visloc.evaluation import pose_error
from visloc.geometry import CAMERA_MODELS, Camera, Pose
from visloc.localization.solving import Matches, Solved, solve_instant
from visloc.options import LocalizeOptions, Solver
from visloc.pose.generalized import estimate_generalized_pose
from visloc.pose.intrinsics import ASPECT, FOCAL, SHIFT_X, SHIFT_Y, find_intrinsics
from visloc.pose.reprojection import MatchedView, project
from visloc.priors import NO_PRIORS, PositionPrior, Priors
from visloc.types import CameraSource, Reason

TRUTH = Pose(Rotation.from_rotvec([0.3, -1.2, 0.4]).as_matrix(), np.array([1.0, -2.0, 0.5]))
RIGHT = Camera("PINHOLE", 640, 480, (520.0, 520.0, 322.0, 239.0))
CAMERAS = (
    RIGHT,
    Camera("SIMPLE_PINHOLE", 640, 480, (500.0, 320.0, 240.0)),
    Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, -0.1)),
    Camera("RADIAL", 640, 480, (500.0, 320.0, 240.0, -0.1, 0.02)),
    Camera("OPENCV", 640, 480, (500.0, 504.0, 320.0, 240.0, -0.1, 0.02, 0.001, -0.001)),
    Camera("OPENCV_FISHEYE", 640, 480, (300.0, 302.0, 320.0, 240.0, 0.01, 0.0, 0.0, 0.0)),
    Camera("FULL_OPENCV", 640, 480, (500.0, 500.0, 320.0, 240.0, -0.1, 0.02, 0, 0, 0, 0, 0, 0)),
    Camera("FOV", 640, 480, (400.0, 400.0, 320.0, 240.0, 0.5)),
    Camera("SIMPLE_RADIAL_FISHEYE", 640, 480, (300.0, 320.0, 240.0, 0.01)),
    Camera("RADIAL_FISHEYE", 640, 480, (300.0, 320.0, 240.0, 0.01, 0.0)),
    Camera("THIN_PRISM_FISHEYE", 640, 480, (300.0, 300.0, 320.0, 240.0, 0.01, 0, 0, 0, 0, 0, 0, 0)),
)


def seen_by(
    camera: Camera,
    *,
    num: int = 400,
    wrong: int = 100,
    noise: float = 1.0,
    depths: tuple[float, float] = (2.0, 8.0),
    seed: int = 0,
    cam_from_world: Pose = TRUTH,
) -> Matches:
    """What a camera sees of points all over its picture, with noise, and some wrong matches."""
    rng = np.random.default_rng(seed)
    slopes = 1.2 * 0.5 * camera.width / camera.focal_length
    rays = np.column_stack([rng.uniform(-slopes, slopes, (40 * num, 2)), np.ones(40 * num)])
    in_cam = rays * rng.uniform(*depths, (len(rays), 1))
    pixels = project(camera, in_cam)
    inside = ((pixels > 0) & (pixels < [camera.width, camera.height])).all(axis=1)
    rows = np.flatnonzero(inside)[:num]
    points, pixels = cam_from_world.inverse().apply(in_cam[rows]), pixels[rows]
    elsewhere = cam_from_world.center + rng.uniform(-8.0, 8.0, (wrong, 3))
    anywhere = rng.uniform([0, 0], [camera.width, camera.height], (wrong, 2))
    return Matches(
        np.vstack([pixels + noise * rng.normal(size=pixels.shape), anywhere]),
        np.vstack([points, elsewhere]),
    )


def changed(camera: Camera, **factors: float) -> Camera:
    """With parameters multiplied; ``cx`` and ``cy`` are moved by so many pixels instead."""
    return replace(
        camera,
        params=tuple(
            value + factors.get(name, 0.0)
            if name in ("cx", "cy")
            else value
            * factors.get("f" if name in ("f", "fx", "fy") else name, 1.0)
            * (factors.get("only_fy", 1.0) if name == "fy" else 1.0)
            for name, value in zip(CAMERA_MODELS[camera.model], camera.params, strict=True)
        ),
    )


def localize(
    place: Any,
    matches: Matches,
    camera: Camera,
    source: CameraSource = CameraSource.GIVEN,
    **options: Any,
) -> Solved:
    image = with_camera(place.image(matches), camera, source)
    return solve_instant([image], place.geometry, LocalizeOptions(**options), NO_PRIORS)


def with_camera(image: Any, camera: Camera, source: CameraSource = CameraSource.GIVEN) -> Any:
    evidence = replace(image.look.evidence, camera=camera, camera_source=source)
    return replace(image, look=replace(image.look, evidence=evidence))


def reason(solved: Solved) -> Reason | None:
    return None if solved.answer.refusal is None else solved.answer.refusal.reason


def message(solved: Solved) -> str:
    assert solved.answer.refusal is not None
    assert solved.answer.refusal.reason is Reason.CAMERA_CONTRADICTED, solved.answer.refusal
    return solved.answer.refusal.message


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.model)
def test_of_every_model_a_right_camera_passes_and_a_wrong_focal_length_is_refused(
    place: Any, camera: Camera
) -> None:
    matches = seen_by(camera)

    assert reason(localize(place, matches, camera)) is None
    for factor in (0.8, 1.3):
        refused = localize(place, matches, changed(camera, f=factor))
        assert f"a focal length of {factor * camera.focal_length:.0f} px" in message(refused)


@pytest.mark.parametrize("factor", [0.5, 0.7, 0.9, 1.1, 1.3, 2.0])
def test_the_focal_length_found_is_the_true_one_within_its_deviation(
    place: Any, factor: float
) -> None:
    for seed in range(5):
        matches = seen_by(RIGHT, seed=seed)
        said = message(localize(place, matches, changed(RIGHT, f=factor)))
        found, std = said.partition("the photo says ")[2].partition(" px")[0].split(" +- ")

        assert abs(float(found) - 520.0) <= 3.0 * float(std) + 1.0
        assert float(std) < 26.0


def test_each_part_of_the_intrinsics_is_found() -> None:
    wrong = changed(RIGHT, f=1.2, cx=50.0, cy=-30.0, only_fy=1.1)
    matches = seen_by(RIGHT, noise=0.5)
    view = MatchedView(wrong, Pose.identity(), matches.pixels, matches.points)
    start = estimate_generalized_pose([view], max_error_px=12.0, seed=0)
    assert start is not None
    found = find_intrinsics(view, start.rig_from_world, max_error_px=12.0)
    assert found is not None
    _, with_all = found

    expected = np.zeros(4)
    expected[FOCAL] = -np.log(1.2) - 0.5 * np.log(1.1)
    expected[[SHIFT_X, SHIFT_Y]] = -50.0 / 640.0, 30.0 / 640.0
    expected[ASPECT] = np.log(1.1)
    std = np.sqrt(np.diag(with_all.covariance))
    np.testing.assert_array_less(np.abs(with_all.change - expected), 3.0 * std)
    np.testing.assert_array_less(np.abs(with_all.change - expected), 0.01)


@pytest.mark.parametrize("right", [60, 160])
def test_wrong_matches_that_lie_evenly_about_a_pose_are_not_counted(right: int) -> None:
    """As where hundreds of them fill the picture: a sixteenth of those near are inliers."""
    wrong = 600
    seen = seen_by(RIGHT, num=right + wrong, wrong=0, noise=0.3)
    rng = np.random.default_rng(0)
    away, turn = 48.0 * np.sqrt(rng.random(wrong)), rng.uniform(0, 2 * np.pi, wrong)
    pixels = seen.pixels.copy()
    pixels[right:] += away[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
    view = MatchedView(changed(RIGHT, f=1.05), Pose.identity(), pixels, seen.points)

    found = find_intrinsics(view, TRUTH, max_error_px=12.0)

    assert found is not None
    for each in found:
        assert each.num_inliers == pytest.approx(right + wrong / 16, abs=25)
        assert each.num_by_chance == pytest.approx(wrong / 16, abs=8)  # some lie outside now


@pytest.mark.parametrize(
    ("camera", "said"),
    [
        (changed(RIGHT, cx=140.0), "was the photo cropped?"),
        (changed(RIGHT, f=0.5, cx=-160.0, cy=-120.0), "was the photo cropped?"),
        (changed(RIGHT, f=0.5), "was the photo cropped around its middle, or zoomed?"),
        (changed(RIGHT, only_fy=1.0 / 0.75), "fx / fy of 0.75, but the photo says"),
        (changed(RIGHT, only_fy=1.0 / 0.75), "was the photo stretched?"),
        (Camera("PINHOLE", 640, 480, (520.0, 520.0, 239.0, 322.0)), "before it was turned?"),
    ],
)
def test_what_was_done_to_the_photo_is_named(place: Any, camera: Camera, said: str) -> None:
    assert said in message(localize(place, seen_by(RIGHT), camera))


def test_a_bent_map_may_shift_the_principal_point_by_a_tenth(place: Any) -> None:
    matches = seen_by(RIGHT)

    assert reason(localize(place, matches, changed(RIGHT, cx=60.0, cy=-40.0))) is None


def flat(noise: float, seed: int) -> Matches:
    """A wall straight ahead: a longer focal length and a longer way to it look the same."""
    return seen_by(RIGHT, depths=(5.0, 5.0), noise=noise, seed=seed)


@pytest.mark.parametrize("noise", [0.2, 1.0, 3.0])
def test_where_the_photo_does_not_tell_the_focal_length_nothing_is_contradicted(
    place: Any, noise: float
) -> None:
    for seed in range(6):
        for factor in (0.9, 1.0, 1.1):
            solved = localize(place, flat(noise, seed), changed(RIGHT, f=factor))
            assert reason(solved) is not Reason.CAMERA_CONTRADICTED


@pytest.mark.parametrize("noise", [0.0, 1.0, 3.0])
@pytest.mark.parametrize("wrong", [0, 600])
def test_a_right_camera_is_never_refused(place: Any, noise: float, wrong: int) -> None:
    for seed in range(10):
        slightly_off = changed(RIGHT, f=1.01, cx=3.0, cy=-3.0)
        matches = seen_by(RIGHT, num=200, noise=noise, wrong=wrong, seed=seed)
        assert reason(localize(place, matches, slightly_off)) is None


def test_errors_that_landmarks_share_do_not_accuse_the_camera(place: Any) -> None:
    """Each of twelve parts of the picture is off as a whole, as where a map's depths are."""
    for seed in range(10):
        matches = seen_by(RIGHT, noise=1.0, seed=seed)
        cells = (matches.pixels // [160.0, 160.0]).astype(int) @ [3, 1]
        shared = np.random.default_rng(seed).normal(0.0, 1.5, (20, 2))
        matches = Matches(matches.pixels + shared[np.clip(cells, 0, 19)], matches.points)
        assert reason(localize(place, matches, RIGHT)) is None


def test_a_wrong_focal_length_of_exif_gives_way_to_the_one_found(place: Any) -> None:
    matches = seen_by(RIGHT)
    wrong = Camera("SIMPLE_PINHOLE", 640, 480, (700.0, 320.0, 240.0))

    solved = localize(place, matches, wrong, CameraSource.EXIF)
    evidence = solved.answer.images[0].evidence

    assert solved.answer.pose is not None
    assert pose_error(solved.answer.pose.rig_from_world, TRUTH)[0] < 0.05
    assert evidence is not None
    assert evidence.camera_source is CameraSource.ESTIMATED
    assert evidence.camera.focal_length == pytest.approx(520.0, rel=0.02)
    assert all(view.focal_unknown for view in solved.views)  # a sequence takes it for no evidence


def test_exif_gives_way_where_its_pose_contradicts_a_prior(place: Any) -> None:
    wrong = Camera("SIMPLE_PINHOLE", 640, 480, (700.0, 320.0, 240.0))
    priors = Priors(PositionPrior(TRUTH.center + place.geometry.origin, 0.3))
    image = with_camera(place.image(seen_by(RIGHT)), wrong, CameraSource.EXIF)

    solved = solve_instant([image], place.geometry, LocalizeOptions(), priors)

    assert solved.answer.pose is not None
    assert solved.views[0].focal_unknown


def test_exif_of_a_cropped_photo_is_no_reason_to_guess(place: Any) -> None:
    """With an estimated focal length the principal point would still be wrong."""
    right = Camera("SIMPLE_PINHOLE", 640, 480, (1040.0, 480.0, 360.0))
    wrong = Camera("SIMPLE_PINHOLE", 640, 480, (520.0, 320.0, 240.0))

    said = message(localize(place, seen_by(right), wrong, CameraSource.EXIF))

    assert said.startswith("the camera from EXIF has")
    assert "was the photo cropped?" in said


def test_a_focal_length_found_with_the_pose_does_not_hide_a_crop(place: Any) -> None:
    right = Camera("SIMPLE_PINHOLE", 640, 480, (520.0, 460.0, 340.0))
    guess = Camera("SIMPLE_PINHOLE", 640, 480, (768.0, 320.0, 240.0))

    solved = localize(place, seen_by(right), guess, CameraSource.GUESS)

    assert message(solved).startswith("the camera found with the pose has")


@pytest.mark.parametrize(
    "options", [{"preset": "config1"}, {"preset": "config2"}, {"solver": Solver.REGISTRATION}]
)
def test_presets_and_solvers_make_no_difference(place: Any, options: dict[str, Any]) -> None:
    matches = seen_by(RIGHT)

    assert reason(localize(place, matches, RIGHT, **options)) is None
    assert "520 px" not in message(localize(place, matches, changed(RIGHT, f=1.3), **options))


def rig(place: Any, cameras: list[Camera], told: list[Camera]) -> Solved:
    images = []
    for i, (camera, given) in enumerate(zip(cameras, told, strict=True)):
        turned = Rotation.from_euler("y", 90 * i, degrees=True).as_matrix()
        cam_from_rig = Pose(turned, np.array([0.2, 0.1 * i, 0.3]))
        matches = seen_by(camera, seed=i, cam_from_world=cam_from_rig @ TRUTH)
        image = place.image(matches, sensor=f"cam{i}", cam_from_rig=cam_from_rig)
        images.append(with_camera(image, given))
    return solve_instant(images, place.geometry, LocalizeOptions(), NO_PRIORS)


def test_each_camera_of_a_rig_is_checked(place: Any) -> None:
    cameras = [RIGHT, CAMERAS[5], CAMERAS[2]]

    assert reason(rig(place, cameras, cameras)) is None
    for i, camera in enumerate(cameras):
        told = [*cameras[:i], changed(camera, f=1.2), *cameras[i + 1 :]]
        assert f"{1.2 * camera.focal_length:.0f} px" in message(rig(place, cameras, told))


def test_matches_that_are_no_numbers_accuse_no_camera(place: Any) -> None:
    matches = seen_by(RIGHT)
    pixels: NDArray[np.float64] = matches.pixels.copy()
    pixels[::7] = np.nan
    points = matches.points.copy()
    points[::11] = np.inf

    assert reason(localize(place, Matches(pixels, points), RIGHT)) is None
