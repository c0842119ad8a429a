"""Cameras that are off in one part, in exact scenes: what is corrected, and what is carried."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from visloc.geometry import Camera, Pose
from visloc.pose.camera_errors import PRIORS, CameraErrors, LensEvidence, find_camera_errors
from visloc.pose.generalized import refine_generalized_pose
from visloc.pose.motion import moved, position_covariance
from visloc.pose.reprojection import MatchedView, project
from visloc.types import CameraSource

TRUE = Camera("PINHOLE", 640, 480, (460.0, 460.0, 322.0, 238.0))
POSE = Pose.from_quaternion(np.array([0.98, 0.05, 0.18, -0.03]), np.array([0.3, -0.2, 0.5]))
GIVEN = PRIORS[CameraSource.GIVEN]
NOISE_PX, MAX_ERROR_PX = 0.4, 12.0
FACTOR = 20.0  # with which one photo does not tell 0.8 % of a focal length
# A turn and a walk while the rows are read.
MOTION = np.array([0.0, 0.01, 0.0, 0.03, 0.0, 0.0])


def seen(
    seed: int,
    taken: Camera = TRUE,
    told: Camera = TRUE,
    motion: NDArray[np.float64] | None = None,
    depth: tuple[float, float] = (2.0, 6.0),
) -> MatchedView:
    """What a camera ``taken`` sees of points in all depths, with the camera that is ``told``."""
    random = np.random.default_rng(seed)
    pixels = random.uniform((0, 0), (640, 480), (900, 2))
    rays = (pixels - (322, 238)) / 460
    along = random.uniform(*depth, 900)
    in_cam = np.column_stack([rays, np.ones(900)]) * along[:, None]
    points = POSE.inverse().apply(in_cam)
    exact = project(taken, in_cam)
    if motion is not None:
        rows = exact[:, 1] / 480 - 0.5
        later = [
            moved(POSE, row * motion).apply(x[None])[0] for row, x in zip(rows, points, strict=True)
        ]
        exact = project(taken, np.array(later))
    return MatchedView(told, Pose.identity(), exact + random.normal(0, NOISE_PX, (900, 2)), points)


def found_in(
    view: MatchedView, factor: float = 1.0, earlier: LensEvidence | None = None
) -> CameraErrors:
    best = refine_generalized_pose([view], POSE, max_error_px=MAX_ERROR_PX)
    assert best is not None
    found = find_camera_errors(
        [view],
        [GIVEN],
        best.rig_from_world,
        earlier=[earlier],
        max_error_px=MAX_ERROR_PX,
        factor=factor,
    )
    assert found is not None
    return found


def changed(**parts: float) -> Camera:
    names = ("fx", "fy", "cx", "cy", "k1")
    values = dict(zip(names, (*TRUE.params, 0.0), strict=True))
    values |= {name: values[name] + by for name, by in parts.items()}
    return Camera("OPENCV", 640, 480, (*(values[name] for name in names), 0.0, 0.0, 0.0))


WRONG = {
    "focal length 2 % too long": changed(fx=9.2, fy=9.2),
    "focal length 4 % too short": changed(fx=-18.4, fy=-18.4),
    "principal point 6 px off": changed(cx=6, cy=-6),
    "distortion of rectified pixels": changed(k1=-0.05),
}


@pytest.mark.parametrize("told", WRONG.values(), ids=WRONG.keys())
def test_wrong_part_of_a_given_camera_is_corrected(told: Camera) -> None:
    found = found_in(seen(0, told=told))
    assert found.corrected
    best = refine_generalized_pose(found.views, found.rig_from_world, max_error_px=MAX_ERROR_PX)
    assert best is not None
    assert np.linalg.norm(best.rig_from_world.center - POSE.center) < 0.01
    camera = dict(zip(("fx", "fy", "cx", "cy", "k1"), found.views[0].camera.params, strict=False))
    assert camera["fx"] == pytest.approx(460, rel=0.005)
    assert (camera["cx"], camera["cy"]) == pytest.approx((322, 238), abs=1.5)
    assert camera["k1"] == pytest.approx(0, abs=0.01)


def test_motion_while_rows_are_read_is_corrected() -> None:
    view = seen(0, motion=MOTION)
    before = refine_generalized_pose([view], POSE, max_error_px=MAX_ERROR_PX)
    found = found_in(view)
    best = refine_generalized_pose(found.views, found.rig_from_world, max_error_px=MAX_ERROR_PX)
    assert before is not None
    assert best is not None
    off = [np.linalg.norm(pose.rig_from_world.center - POSE.center) for pose in (before, best)]
    assert off[1] < 0.003 < off[0]
    assert found.views[0].camera == TRUE


@pytest.mark.parametrize("seed", range(8))
def test_right_camera_stays_to_the_last_bit(seed: int) -> None:
    view = seen(seed)
    found = found_in(view)
    assert not found.corrected
    assert found.views == (view,)


def test_errors_that_the_landmarks_share_take_the_say_from_the_photo() -> None:
    view = seen(0, told=WRONG["focal length 2 % too long"])
    assert found_in(view).corrected
    assert not found_in(view, factor=200.0).corrected


@pytest.mark.parametrize(
    ("told", "corrected"), [(changed(fx=3.7, fy=3.7), True), (TRUE, False)], ids=["wrong", "right"]
)
def test_several_photos_of_a_camera_say_more_than_one(told: Camera, corrected: bool) -> None:
    told_by_one, earlier, found = 0, None, None
    for seed in range(8):
        view = seen(seed, told=told)
        told_by_one += found_in(view, factor=FACTOR).corrected
        found = found_in(view, FACTOR, earlier)
        (evidence,) = found.evidence
        assert evidence is not None
        earlier = evidence.with_earlier(earlier)
    assert found is not None
    assert told_by_one == 0
    assert found.corrected is corrected
    assert found.views[0].camera.focal_length == pytest.approx(460, rel=0.003)


def test_evidence_of_earlier_photos_fades() -> None:
    (evidence,) = found_in(seen(0)).evidence
    assert evidence is not None
    kept = None
    for _ in range(200):
        kept = evidence.with_earlier(kept)
    assert kept is not None
    np.testing.assert_allclose(kept.information, 9 * evidence.information, rtol=1e-6)


def test_wall_parallel_to_the_picture_does_not_tell_the_focal_length() -> None:
    view = seen(0, told=WRONG["focal length 2 % too long"], depth=(4.0, 4.02))
    assert not found_in(view).corrected


def test_distortion_of_another_lens_is_carried_and_not_corrected() -> None:
    found = found_in(seen(0, taken=changed(k1=-0.9)))
    right = found_in(seen(0))
    assert not found.corrected
    std, std_of_right = (
        np.sqrt(np.trace(position_covariance(each.rig_from_world, each.of_camera)))
        for each in (found, right)
    )
    assert std > 20 * std_of_right


def test_wrong_coefficient_of_a_distorted_camera_is_corrected() -> None:
    found = found_in(seen(0, taken=changed(k1=-0.25), told=changed(k1=-0.30)))
    assert found.corrected
    assert found.views[0].camera.params[4] == pytest.approx(-0.25, abs=0.005)
    assert np.linalg.norm(found.rig_from_world.center - POSE.center) < 0.004


def test_matches_that_are_no_numbers_or_wrong_change_nothing() -> None:
    view, random = seen(0, motion=2 * MOTION), np.random.default_rng(1)
    wrong = view.points[:300] * random.uniform(10, 20, (300, 1))
    more = replace(
        view,
        pixels=np.concatenate([view.pixels, view.pixels[:301]]),
        points=np.concatenate([view.points, wrong, np.full((1, 3), np.nan)]),
    )
    found, beside = found_in(view), found_in(more)
    np.testing.assert_allclose(beside.views[0].pixels[:900], found.views[0].pixels, atol=0.05)


def test_known_error_of_exif_is_carried_where_few_matches_tell() -> None:
    few = seen(0).selected(np.arange(14))
    stated = {}
    for source in (CameraSource.GIVEN, CameraSource.EXIF):
        found = find_camera_errors(
            [few], [PRIORS[source]], POSE, max_error_px=MAX_ERROR_PX, factor=1.0
        )
        assert found is not None
        stated[source] = np.trace(position_covariance(found.rig_from_world, found.of_camera))
    assert stated[CameraSource.EXIF] > 10 * stated[CameraSource.GIVEN]


def test_rig_view_that_shows_nothing_weighs_nothing() -> None:
    behind = seen(1)
    behind = replace(behind, points=2 * POSE.center - behind.points)
    alone, beside = (
        find_camera_errors(views, [GIVEN] * len(views), POSE, max_error_px=MAX_ERROR_PX, factor=1.0)
        for views in ([seen(0)], [seen(0), behind])
    )
    assert alone is not None
    assert beside is not None
    np.testing.assert_array_equal(alone.of_camera, beside.of_camera)


def test_stated_part_of_the_camera_covers_what_is_left() -> None:
    inside = 0
    for seed in range(20):
        view = seen(seed, told=WRONG["focal length 2 % too long"])
        found = found_in(view)
        best = refine_generalized_pose(found.views, found.rig_from_world, max_error_px=MAX_ERROR_PX)
        assert best is not None
        assert best.covariance is not None
        whole = position_covariance(best.rig_from_world, best.covariance + found.of_camera)
        error = best.rig_from_world.center - POSE.center
        inside += bool(error @ np.linalg.solve(whole, error) <= 7.81)  # 95 % of chi-square
    assert inside >= 17


def test_wrong_camera_of_a_rig_leaves_the_other_alone() -> None:
    right, wrong = seen(0), seen(1, told=WRONG["principal point 6 px off"])
    found = find_camera_errors(
        [right, wrong], [GIVEN, GIVEN], POSE, max_error_px=MAX_ERROR_PX, factor=1.0
    )
    assert found is not None
    assert found.views[0].camera.params[:4] == pytest.approx(TRUE.params, abs=0.3)
    assert found.views[1].camera.params[2:4] == pytest.approx((322, 238), abs=0.5)


def test_views_without_matches_stay_as_they_are() -> None:
    none = seen(0).selected(np.zeros(900, bool))
    found = find_camera_errors(
        [none, seen(1)], [GIVEN, GIVEN], POSE, max_error_px=MAX_ERROR_PX, factor=1.0
    )
    assert found is not None
    assert found.views[0] is none


@pytest.mark.parametrize("rows", [0, 10])
def test_few_matches_tell_nothing(rows: int) -> None:
    few = seen(0).selected(np.arange(rows))
    assert find_camera_errors([few], [GIVEN], POSE, max_error_px=12.0, factor=1.0) is None


@pytest.mark.parametrize("source", [CameraSource.GIVEN, CameraSource.EXIF, CameraSource.ESTIMATED])
@pytest.mark.parametrize("spread", [0.0, 1e-9])
def test_points_on_a_line_or_in_a_spot_tell_nothing(source: CameraSource, spread: float) -> None:
    view, random = seen(0), np.random.default_rng(0)
    for ends in (np.zeros(3), np.array([1.0, 0.0, 0.0])):
        in_cam = np.array([0.1, 0.1, 4.0]) + random.uniform(0, 1, (900, 1)) * ends
        in_cam += random.normal(0, spread, (900, 3)) if spread else 0.0
        points = POSE.inverse().apply(in_cam)
        line = replace(view, points=points, pixels=project(TRUE, in_cam))
        found = find_camera_errors(
            [line], [PRIORS[source]], POSE, max_error_px=MAX_ERROR_PX, factor=1.0
        )
        assert found is None or np.isfinite(found.of_camera).all()


def test_fisheye_keeps_its_distortion() -> None:
    fisheye = Camera("OPENCV_FISHEYE", 640, 480, (*TRUE.params, 0.02, 0.0, 0.0, 0.0))
    longer = replace(fisheye, params=(469.2, 469.2, *fisheye.params[2:]))
    found = found_in(seen(0, taken=fisheye, told=longer))
    assert found.corrected
    assert found.views[0].camera.params[4:] == fisheye.params[4:]
    assert found.views[0].camera.params[0] == pytest.approx(460, rel=0.005)
