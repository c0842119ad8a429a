from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from visloc.errors import InvalidInput
from visloc.evaluation import pose_error
from visloc.geometry import Camera, Pose, center_covariance
from visloc.localization.acceptance.gates import registration_for
from visloc.localization.solving import Matches, Solved, measured_pose, solve_instant
from visloc.options import LocalizeOptions
from visloc.pose.generalized import GeneralizedPose
from visloc.pose.motion import MapErrors, with_origin
from visloc.pose.reprojection import normalized_rays
from visloc.priors import (
    NO_PRIORS,
    GravityPrior,
    HeightBand,
    PosePrior,
    PositionPrior,
    Priors,
)
from visloc.types import CameraSource, PoseSource, Reason, Refusal, Uncertainty

OPTIONS = LocalizeOptions()
TRUTH = Pose(Rotation.from_rotvec([0.3, -1.2, 0.4]).as_matrix(), np.array([1.0, -2.0, 0.5]))
# Looking ahead, right, back and left from the corners of a roof.
RIG = [
    Pose(Rotation.from_euler("y", 90 * i, degrees=True).as_matrix(), np.array([0.2, 0.1 * i, 0.3]))
    for i in range(4)
]
CHI2_6_999 = 22.46


def rig_images(place: Any, right: int, wrong: int, *, noise: float = 0.5) -> list[Any]:
    """Four cameras, each with so many right and wrong correspondences."""
    return [
        place.image(
            place.matches(cam_from_rig @ TRUTH, right, wrong, seed=i, noise=noise),
            sensor=f"cam{i}",
            cam_from_rig=cam_from_rig,
        )
        for i, cam_from_rig in enumerate(RIG)
    ]


def solve(images: list[Any], place: Any, priors: Priors = NO_PRIORS, **options: Any) -> Solved:
    return solve_instant(images, place.geometry, LocalizeOptions(**options), priors, 7)


def error_of(solved: Solved, place: Any, truth: Pose = TRUTH) -> tuple[float, float]:
    assert solved.answer.pose is not None, solved.answer.refusal
    return pose_error(solved.answer.pose.rig_from_world, place.to_world(truth))


def reason(solved: Solved) -> Reason | None:
    refusal = solved.answer.refusal
    assert (refusal is None) == (solved.answer.pose is not None)
    assert (refusal is None) == (solved.pose is not None)
    return None if refusal is None else refusal.reason


def normalized_error2(solved: Solved, place: Any, truth: Pose = TRUTH) -> float:
    """Of the answer's pose, squared, by its own covariance, in terms of the centre."""
    pose = solved.answer.pose
    assert pose is not None
    right = place.to_world(truth)
    w = Rotation.from_matrix(pose.rig_from_world.rotation @ right.rotation.T).as_rotvec()
    error = np.concatenate([w, pose.rig_from_world.center - right.center])
    covariance = center_covariance(pose.rig_from_world, pose.covariance)
    return float(error @ np.linalg.solve(covariance, error))


# Rigs


def test_a_rig_is_localized_where_none_of_its_cameras_would_be(place: Any) -> None:
    images = rig_images(place, right=12, wrong=20)
    for image in images:
        assert reason(solve([image], place)) is Reason.TOO_FEW_INLIERS

    together = solve(images, place)
    assert reason(together) is None
    assert error_of(together, place) < (0.05, 0.2)
    answer = together.answer
    assert answer.timestamp == 7
    assert answer.pose is not None
    assert answer.pose.source is PoseSource.ESTIMATED
    assert answer.num_correspondences == 4 * 32
    assert 46 <= answer.num_inliers <= 52
    assert [image.sensor for image in answer.images] == ["cam0", "cam1", "cam2", "cam3"]
    assert all(i.evidence is not None and i.evidence.num_inliers >= 11 for i in answer.images)
    assert answer.seconds["local_features"] == pytest.approx(4 * 0.5)


def test_the_gate_counts_all_cameras_together(place: Any) -> None:
    images = rig_images(place, right=10, wrong=0)
    assert reason(solve(images, place, min_inliers=40)) is None
    assert reason(solve(images, place, min_inliers=41)) is Reason.TOO_FEW_MATCHES
    images = rig_images(place, right=10, wrong=10)
    assert reason(solve(images, place, min_inliers=60)) is Reason.TOO_FEW_INLIERS
    assert reason(solve(images, place, min_inlier_ratio=0.45)) is None
    refused = solve(images, place, min_inlier_ratio=0.7)
    assert reason(refused) is Reason.LOW_INLIER_RATIO
    # What was seen is told all the same.
    assert refused.answer.num_inliers >= 40


def test_a_camera_that_sees_only_wrong_things_does_no_harm(place: Any) -> None:
    images = rig_images(place, right=40, wrong=0)
    images[1] = place.image(
        place.matches(TRUTH, 0, 200, seed=9), sensor="cam1", cam_from_rig=RIG[1]
    )
    solved = solve(images, place)
    assert error_of(solved, place) < (0.03, 0.1)
    evidence = solved.answer.images[1].evidence
    assert evidence is not None
    assert evidence.num_inliers < 10


@pytest.mark.parametrize("broken", [0, 2, 3])
def test_an_image_that_cannot_be_used_fails_alone(place: Any, broken: int) -> None:
    images = rig_images(place, right=30, wrong=10)
    all_four = solve(images, place)
    sensor = f"cam{broken}"
    images[broken] = place.image(None, sensor=sensor, cam_from_rig=RIG[broken])

    solved = solve(images, place)

    assert error_of(solved, place) < (0.05, 0.2)
    assert len(solved.views) == 3
    for i, (image, of_four) in enumerate(
        zip(solved.answer.images, all_four.answer.images, strict=True)
    ):
        assert image.sensor == f"cam{i}"
        assert image.cam_from_rig is RIG[i]
        if i == broken:
            assert image.evidence is None
            assert image.error is not None
            assert image.error.code == "image.format"
        else:
            # Each mask goes to the image that it is of.
            assert image.error is None
            assert image.evidence is not None
            assert of_four.evidence is not None
            assert abs(image.evidence.num_inliers - of_four.evidence.num_inliers) <= 3


def test_without_any_usable_image_there_is_an_answer_and_no_pose(place: Any) -> None:
    for images in ([], [place.image(None), place.image(None, sensor="other")]):
        solved = solve(images, place)
        assert reason(solved) is Reason.NO_USABLE_IMAGE
        assert solved.views == ()
        assert solved.answer.num_inliers == solved.answer.num_correspondences == 0
        assert len(solved.answer.images) == len(images)


def test_what_is_wrong_with_all_images_is_said_in_the_words_of_the_first(place: Any) -> None:
    blank = Refusal("features", Reason.NO_KEYPOINTS, "blank")
    off = Refusal("retrieval", Reason.NO_PHOTO_NEAR, "nothing there")
    images = [
        place.image(None),
        place.image(Matches.none(), sensor="a", refusal=blank),
        place.image(Matches.none(), sensor="b", refusal=off),
    ]
    assert solve(images, place).answer.refusal == blank
    # One that shows the place is enough.
    images.append(place.image(place.matches(TRUTH, 60), sensor="c"))
    assert error_of(solve(images, place), place) < (0.05, 0.2)


def test_matches_in_a_line_are_refused(place: Any) -> None:
    line = place.matches(TRUTH, 60, noise=0.0)
    along = np.linspace(0.0, 1.0, 60)[:, None] * (line.points[1] - line.points[0])
    points = line.points[0] + along
    seen = TRUTH.apply(points)
    fx, fy, cx, cy = place.camera.params
    pixels = np.column_stack([fx * seen[:, 0] / seen[:, 2] + cx, fy * seen[:, 1] / seen[:, 2] + cy])
    solved = solve([place.image(Matches(pixels, points))], place)
    assert reason(solved) in (Reason.UNCERTAIN_POSE, Reason.NO_POSE, Reason.TOO_FEW_INLIERS)


def test_correspondences_that_are_no_numbers_are_left_out(place: Any) -> None:
    matches = place.matches(TRUTH, 80)
    matches.points[3] = np.nan
    matches.pixels[5] = np.inf
    solved = solve([place.image(matches)], place)
    assert error_of(solved, place) < (0.05, 0.2)
    assert solved.answer.num_inliers <= 78


def test_the_threshold_shrinks_with_the_smallest_camera_of_a_rig() -> None:
    large = Camera("SIMPLE_PINHOLE", 1280, 960, (900.0, 640.0, 480.0))
    small = Camera("SIMPLE_PINHOLE", 320, 240, (250.0, 160.0, 120.0))
    assert registration_for(OPTIONS, [large]).max_error_px == 12.0
    assert registration_for(OPTIONS, [large, small]).max_error_px == 6.0
    named = LocalizeOptions(max_error_px=9.0)
    assert registration_for(named, [large, small]).max_error_px == 9.0
    assert registration_for(LocalizeOptions(preset="config1"), [small]).max_error_px == 12.0


def test_a_photo_is_a_rig_of_one_and_the_same_seed_gives_the_same_bits(place: Any) -> None:
    images = rig_images(place, right=20, wrong=40)
    for some in (images, images[:1]):
        first, again = solve(some, place, seed=3), solve(some, place, seed=3)
        assert first.answer.num_inliers == again.answer.num_inliers
        if first.answer.pose is not None and again.answer.pose is not None:
            for name in ("covariance", "position_std", "orientation_std"):
                assert np.array_equal(
                    getattr(first.answer.pose, name), getattr(again.answer.pose, name)
                )


def test_far_from_the_origin_pose_and_uncertainty_are_those_of_here(
    place: Any, far_place: Any
) -> None:
    images = rig_images(place, right=25, wrong=10)
    here, far = solve(images, place).answer.pose, solve(images, far_place).answer.pose
    assert here is not None
    assert far is not None
    shift = far.rig_from_world.center - far_place.origin - here.rig_from_world.center
    assert np.abs(shift).max() < 1e-8
    assert np.array_equal(far.rig_from_world.rotation, here.rig_from_world.rotation)
    assert np.array_equal(far.position_std, here.position_std)
    assert far.orientation_std == pytest.approx(here.orientation_std)
    # The covariance of t is huge there, and exactly so wide that the centre is as sure as here.
    back = with_origin(far.rig_from_world, far.covariance, -far_place.origin)[1]
    scale = np.sqrt(np.diag(here.covariance))
    assert np.abs((back - here.covariance) / np.outer(scale, scale)).max() < 1e-2
    assert np.sqrt(far.covariance[3, 3]) > 100.0


def test_errors_are_as_large_as_the_covariance_says_near_and_far(
    place: Any, far_place: Any
) -> None:
    # 60 seeded trials of six degrees of freedom: chi-square with 360, 95 % within 308 to 414.
    total = 0.0
    for seed in range(60):
        images = [
            place.image(
                place.matches(cam_from_rig @ TRUTH, 15, 5, seed=10 * seed + i),
                sensor=str(i),
                cam_from_rig=cam_from_rig,
            )
            for i, cam_from_rig in enumerate(RIG[:3])
        ]
        where = place if seed % 2 else far_place
        total += normalized_error2(solve(images, where), where)
    assert 308 - 60 < total < 414


# Priors


def pose_prior(pose: Pose, std_rad: float, std: float) -> PosePrior:
    """A prior whose device is known to std about and along each axis of the device."""
    lever = np.eye(6)
    t = pose.translation
    lever[3:, :3] = -np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    lever[3:, 3:] = -pose.rotation
    covariance = lever @ np.diag([std_rad**2] * 3 + [std**2] * 3) @ lever.T
    return PosePrior(pose, (covariance + covariance.T) / 2)


def test_a_position_that_is_right_changes_nothing(hall: Any) -> None:
    images = rig_images(hall, right=20, wrong=20)
    plain = solve(images, hall)
    center = hall.to_world(TRUTH).center
    priors = Priors(
        PositionPrior(center + np.array([0.4, 0.0, 0.0]), 0.5),
        HeightBand(center[2] - 1.0, center[2] + 1.0),
    )
    held = solve(images, hall, priors)
    assert plain.answer.pose is not None
    assert held.answer.pose is not None
    assert np.array_equal(held.answer.pose.covariance, plain.answer.pose.covariance)
    assert np.array_equal(
        held.answer.pose.rig_from_world.translation, plain.answer.pose.rig_from_world.translation
    )


@pytest.mark.parametrize("away", [0.7, 3.0, 1e3, 1e9, 1e14])
def test_a_position_that_lies_costs_the_answer_and_says_by_how_much(hall: Any, away: float) -> None:
    center = hall.to_world(TRUTH).center
    priors = Priors(PositionPrior(center + np.array([away, 0.0, 0.0]), 0.5))
    solved = solve(rig_images(hall, 20, 20), hall, priors)
    assert reason(solved) is Reason.CONTRADICTS_PRIOR
    assert solved.answer.refusal is not None
    assert "prior position" in solved.answer.refusal.message
    assert len(solved.answer.refusal.message) < 1000


def test_a_pose_may_be_as_far_beyond_an_area_as_it_is_uncertain(hall: Any) -> None:
    # Far landmarks in a narrow bundle: the depth is known to about half a metre.
    rng = np.random.default_rng(0)
    pixels = rng.uniform([300, 220], [344, 258], (60, 2))
    rays = np.column_stack([(pixels - [322.0, 239.0]) / [500.0, 510.0], np.ones(60)])
    points = TRUTH.inverse().apply(rays * rng.uniform(5.0, 9.0, (60, 1)))
    image = hall.image(Matches(pixels + rng.normal(size=pixels.shape) * 0.5, points))
    solved = solve([image], hall)
    assert solved.answer.pose is not None
    worst = float(np.linalg.norm(solved.answer.pose.position_std))
    assert worst > 0.02
    center = solved.answer.pose.rig_from_world.center
    away = np.array([0.0, 0.0, 1.0 + 2.0 * worst])
    assert reason(solve([image], hall, Priors(PositionPrior(center + away, 1.0)))) is None
    away = np.array([0.0, 0.0, 1.0 + 4.0 * worst])
    assert (
        reason(solve([image], hall, Priors(PositionPrior(center + away, 1.0))))
        is Reason.CONTRADICTS_PRIOR
    )


def test_a_height_band_refuses_what_lies_outside(hall: Any) -> None:
    images = rig_images(hall, 30, 0)
    height = float(TRUTH.center[2])
    assert reason(solve(images, hall, Priors(height=HeightBand(height - 1, height + 1)))) is None
    for low, high in ((height + 0.5, height + 3.0), (height - 3.0, height - 0.5), (-1e308, -1e9)):
        refused = solve(images, hall, Priors(height=HeightBand(low, high)))
        assert reason(refused) is Reason.CONTRADICTS_PRIOR
    assert reason(solve(images, hall, Priors(height=HeightBand(-1e308, 1e308)))) is None


def test_height_counts_along_the_up_that_the_request_brings(place: Any) -> None:
    images = rig_images(place, 30, 0)
    sideways = GravityPrior(
        TRUTH.rotation @ [1.0, 0.0, 0.0], np.radians(1.0), np.array([1.0, 0.0, 0.0])
    )
    up_is_minus_x = -float(TRUTH.center[0])
    fits = HeightBand(up_is_minus_x - 0.5, up_is_minus_x + 0.5)
    assert reason(solve(images, place, Priors(height=fits, gravity=sideways))) is None
    off = HeightBand(up_is_minus_x + 0.5, up_is_minus_x + 1.5)
    refused = solve(images, place, Priors(height=off, gravity=sideways))
    assert reason(refused) is Reason.CONTRADICTS_PRIOR


@pytest.mark.parametrize(
    "priors",
    [
        Priors(height=HeightBand(0.0, 3.0)),
        Priors(gravity=GravityPrior(np.array([0.0, 1.0, 0.0]), 0.02)),
    ],
)
def test_without_a_down_gravity_and_height_mean_nothing(place: Any, priors: Priors) -> None:
    with pytest.raises(InvalidInput) as caught:
        solve(rig_images(place, 30, 0), place, priors)
    assert caught.value.code in ("priors.gravity", "priors.height")
    assert caught.value.expected is not None
    assert "priors.gravity with its world" in caught.value.expected


def tilted(down: np.ndarray[Any, Any], degrees: float) -> np.ndarray[Any, Any]:
    across = np.cross(down, [0.3, 0.5, 0.8])
    return Rotation.from_rotvec(np.radians(degrees) * across / np.linalg.norm(across)).apply(down)


@pytest.mark.parametrize("right", [30, 5])
@pytest.mark.parametrize("off_deg", [0.0, 1.0, 2.0, 5.0, 30.0, 90.0, 180.0])
def test_gravity_that_is_wrong_costs_the_answer_and_never_its_truth(
    hall: Any, off_deg: float, right: int
) -> None:
    rig = rig_images(hall, right, 20) if right > 10 else rig_images(hall, 12, 60)
    down = tilted(TRUTH.rotation @ hall.down, off_deg)
    solved = solve(rig, hall, Priors(gravity=GravityPrior(down, np.radians(1.0))))
    if off_deg <= 2.0:
        assert error_of(solved, hall) < (0.06, 0.3)
    else:
        assert reason(solved) is not None


def test_gravity_finds_what_is_lost_without_it(hall: Any) -> None:
    # One correspondence in fourteen is right.
    matches = hall.matches(TRUTH, 45, 600, seed=2)
    down = TRUTH.rotation @ hall.down
    prior = Priors(gravity=GravityPrior(tilted(down, 0.5), np.radians(1.0)))
    assert error_of(solve([hall.image(matches)], hall, prior), hall) < (0.05, 0.3)


def test_gravity_does_not_pick_a_pose_that_the_photo_hardly_shows(hall: Any) -> None:
    # A lie of 40 degrees fits the smaller of two structures exactly.
    image, _ = twins(hall, here=55, there=100)
    lie = Priors(gravity=GravityPrior(TRUTH.rotation @ hall.down, np.radians(1.0)))
    solved = solve([image], hall, lie)
    assert reason(solved) is Reason.CONTRADICTS_PRIOR
    # Where both are as strong, it decides.
    image, other = twins(hall, here=90, there=100)
    assert error_of(solve([image], hall, lie), hall) < (0.05, 0.2)
    turned = Priors(gravity=GravityPrior(other.rotation @ hall.down, np.radians(1.0)))
    assert error_of(solve([image], hall, turned), hall, other) < (0.05, 0.2)


@pytest.mark.parametrize("off_deg", [4.0, 6.0, 90.0, 180.0])
def test_a_request_may_know_down_a_little_better_than_the_map(hall: Any, off_deg: float) -> None:
    images = rig_images(hall, 30, 0)
    world = tilted(hall.down, off_deg)
    priors = Priors(gravity=GravityPrior(TRUTH.rotation @ world, np.radians(0.5), world))
    if off_deg < 5.0:
        assert error_of(solve(images, hall, priors), hall) < (0.05, 0.2)
        return
    with pytest.raises(InvalidInput) as caught:
        solve(images, hall, priors)
    assert (caught.value.code, caught.value.field) == ("priors.gravity", "priors.gravity.world")


@pytest.mark.parametrize("sigmas", [0.0, 2.0])
def test_a_pose_prior_that_is_right_is_obeyed_and_does_not_bend(
    far_place: Any, sigmas: float
) -> None:
    images = rig_images(far_place, 30, 10)
    plain = solve(images, far_place)
    world = far_place.to_world(TRUTH)
    turn = Rotation.from_rotvec([0.0, sigmas * 0.02, 0.0]).as_matrix()
    center = world.center + np.array([sigmas * 0.2, 0.0, 0.0])
    before = Pose(turn @ world.rotation, -turn @ world.rotation @ center)
    held = solve(images, far_place, Priors(pose=pose_prior(before, 0.02, 0.2)))
    assert plain.answer.pose is not None
    assert held.answer.pose is not None, held.answer.refusal
    assert np.array_equal(
        held.answer.pose.rig_from_world.translation, plain.answer.pose.rig_from_world.translation
    )


@pytest.mark.parametrize(("turn_deg", "away"), [(0.0, 2.0), (10.0, 0.0), (180.0, 0.0), (0.0, 1e5)])
def test_a_pose_prior_that_lies_costs_the_answer(
    far_place: Any, turn_deg: float, away: float
) -> None:
    world = far_place.to_world(TRUTH)
    turn = Rotation.from_euler("z", turn_deg, degrees=True).as_matrix()
    center = world.center + np.array([0.0, away, 0.0])
    lie = Pose(turn @ world.rotation, -turn @ world.rotation @ center)
    solved = solve(
        rig_images(far_place, 30, 10), far_place, Priors(pose=pose_prior(lie, 0.02, 0.2))
    )
    assert reason(solved) is Reason.CONTRADICTS_PRIOR
    assert solved.answer.refusal is not None
    assert "prior pose" in solved.answer.refusal.message


@pytest.mark.parametrize("where", ["place", "far_place"])
def test_the_covariance_of_an_answer_may_be_sent_back_as_a_prior(
    where: str, request: pytest.FixtureRequest
) -> None:
    here = request.getfixturevalue(where)
    images = rig_images(here, 30, 10)
    pose = solve(images, here).answer.pose
    assert pose is not None
    held = solve(images, here, Priors(pose=PosePrior(pose.rig_from_world, pose.covariance)))
    assert error_of(held, here) < (0.05, 0.2)
    off = Pose(
        pose.rig_from_world.rotation, pose.rig_from_world.translation + np.array([0.5, 0.0, 0.0])
    )
    refused = solve(images, here, Priors(pose=PosePrior(off, pose.covariance)))
    assert reason(refused) is Reason.CONTRADICTS_PRIOR


def twins(place: Any, here: int, there: int, *, seed: int = 0) -> tuple[Any, Pose]:
    """One image that fits two poses, TRUTH and another, with so many correspondences each."""
    other = Pose(
        Rotation.from_euler("y", 40, degrees=True).as_matrix() @ TRUTH.rotation,
        TRUTH.translation + np.array([6.0, 0.0, 2.0]),
    )
    a = place.matches(TRUTH, here, seed=2 * seed)
    b = place.matches(other, there, seed=2 * seed + 1)
    both = Matches(np.vstack([a.pixels, b.pixels]), np.vstack([a.points, b.points]))
    return place.image(both), other


def test_a_pose_prior_decides_where_the_photo_leaves_the_place_open(far_place: Any) -> None:
    image, other = twins(far_place, here=80, there=100)
    assert error_of(solve([image], far_place), far_place, other) < (0.05, 0.2)
    for truth in (TRUTH, other):
        prior = pose_prior(far_place.to_world(truth), 0.03, 0.3)
        solved = solve([image], far_place, Priors(pose=prior))
        assert error_of(solved, far_place, truth) < (0.05, 0.2)
        # The answer's inliers are those of the pose that was chosen.
        assert solved.pose is not None
        assert solved.answer.num_inliers == solved.pose.num_inliers >= 78


def test_a_pose_prior_does_not_decide_against_what_the_photo_clearly_shows(far_place: Any) -> None:
    image, other = twins(far_place, here=60, there=100)
    lie = pose_prior(far_place.to_world(TRUTH), 0.03, 0.3)
    assert reason(solve([image], far_place, Priors(pose=lie))) is Reason.CONTRADICTS_PRIOR
    right = pose_prior(far_place.to_world(other), 0.03, 0.3)
    assert reason(solve([image], far_place, Priors(pose=right))) is None


def test_the_other_priors_hold_where_a_pose_prior_decides(far_place: Any) -> None:
    image, other = twins(far_place, here=80, there=100)
    near = pose_prior(far_place.to_world(TRUTH), 0.03, 0.3)
    elsewhere = PositionPrior(far_place.to_world(other).center, 0.5)
    solved = solve([image], far_place, Priors(position=elsewhere, pose=near))
    assert reason(solved) is Reason.CONTRADICTS_PRIOR


def test_a_place_that_the_priors_exclude_and_that_fits_better_refuses_the_answer(
    hall: Any,
) -> None:
    inside = hall.matches(TRUTH, 60, 100, seed=1)
    _, other = twins(hall, 1, 1)
    center = hall.to_world(TRUTH).center
    priors = Priors(PositionPrior(center, 1.0))
    for count, expected in ((100, Reason.CONTRADICTS_PRIOR), (75, None), (20, None), (0, None)):
        image = hall.image(inside, elsewhere=hall.matches(other, count, 30 if count else 0, seed=5))
        assert reason(solve([image], hall, priors)) is expected


def test_what_the_priors_exclude_is_searched_without_exif_where_the_photo_contradicts_it(
    hall: Any,
) -> None:
    _, other = twins(hall, 1, 1)
    priors = Priors(PositionPrior(hall.to_world(TRUTH).center, 20.0))
    wrong = Camera("SIMPLE_PINHOLE", 640, 480, (1000.0, 322.0, 239.0))
    for count, expected in ((400, Reason.CONTRADICTS_PRIOR), (0, None)):
        image = hall.image(
            hall.matches(TRUTH, 200, 30, seed=1), elsewhere=hall.matches(other, count, seed=5)
        )
        evidence = replace(image.look.evidence, camera=wrong, camera_source=CameraSource.EXIF)
        image = replace(image, look=replace(image.look, evidence=evidence))
        solved = solve([image], hall, priors)
        assert reason(solved) is expected
        assert solved.views[0].focal_unknown


def test_a_photo_that_shows_only_what_the_priors_exclude_is_told_so(hall: Any) -> None:
    _, other = twins(hall, 1, 1)
    priors = Priors(PositionPrior(hall.to_world(TRUTH).center, 1.0))
    inside = [hall.matches(TRUTH, 10, 50, seed=1), hall.matches(TRUTH, 3, seed=1), Matches.none()]
    for matches in inside:
        image = hall.image(matches, elsewhere=hall.matches(other, 60, 20, seed=5))
        assert reason(solve([image], hall, priors)) is Reason.CONTRADICTS_PRIOR
        # What is elsewhere would not have been believed there either.
        chance = hall.image(matches, elsewhere=hall.matches(other, 20, 20, seed=5))
        assert reason(solve([chance], hall, priors)) in (
            Reason.TOO_FEW_INLIERS,
            Reason.TOO_FEW_MATCHES,
        )


def test_what_a_rig_sees_elsewhere_is_counted_over_all_its_cameras(hall: Any) -> None:
    _, other = twins(hall, 1, 1)
    images = [
        hall.image(
            hall.matches(cam_from_rig @ TRUTH, 15, 20, seed=i),
            sensor=str(i),
            cam_from_rig=cam_from_rig,
            elsewhere=hall.matches(cam_from_rig @ other, 30, 10, seed=10 + i),
        )
        for i, cam_from_rig in enumerate(RIG)
    ]
    priors = Priors(PositionPrior(hall.to_world(TRUTH).center, 1.0))
    solved = solve(images, hall, priors)
    assert reason(solved) is Reason.CONTRADICTS_PRIOR
    assert solved.answer.refusal is not None
    assert "look alike" in solved.answer.refusal.message
    assert solved.answer.num_inliers >= 50  # those of the pose that was refused


HUGE = np.diag([1e15] * 6)


@pytest.mark.parametrize(
    "prior",
    [
        PosePrior(TRUTH, HUGE),
        PosePrior(TRUTH, np.diag([1e-300] * 6)),
        PosePrior(Pose(np.eye(3), np.full(3, 1e15)), np.eye(6)),
        PosePrior(Pose(np.eye(3), np.full(3, 1e15)), HUGE),
        PosePrior(TRUTH, np.diag([1e15] * 3 + [1e-300] * 3)),
    ],
)
def test_pose_priors_of_absurd_size_are_answered_and_give_no_wrong_pose(
    far_place: Any, prior: PosePrior
) -> None:
    solved = solve(rig_images(far_place, 30, 10), far_place, Priors(pose=prior))
    if reason(solved) is None:
        assert error_of(solved, far_place) < (0.05, 0.2)


def some_prior(rng: np.random.Generator, truth: Pose) -> Priors:
    """Each kind with even odds, right or lying with even odds."""

    def lie(size: float) -> np.ndarray[Any, Any]:
        direction = rng.normal(size=3)
        length = size * (10 ** rng.uniform(-1.5, 1.5)) * rng.integers(0, 2)
        return length * direction / np.linalg.norm(direction)

    center = truth.center
    position = height = pose = gravity = None
    if rng.random() < 0.5:
        position = PositionPrior(center + lie(5.0), float(rng.uniform(0.1, 5.0)))
    if rng.random() < 0.5:
        low = center[2] + lie(3.0)[2] - rng.uniform(0.1, 3.0)
        height = HeightBand(float(low), float(low + rng.uniform(0.5, 5.0)))
    if rng.random() < 0.5:
        turn = Rotation.from_rotvec(lie(0.3)).as_matrix() @ truth.rotation
        before = Pose(turn, -turn @ (center + lie(2.0)))
        pose = pose_prior(before, rng.uniform(0.005, 0.1), rng.uniform(0.05, 1.0))
    if rng.random() < 0.5:
        down = Rotation.from_rotvec(lie(0.2)).apply(truth.rotation @ [0.0, 0.0, -1.0])
        gravity = GravityPrior(down, np.radians(rng.uniform(0.2, 5.0)))
    return Priors(position, height, pose, gravity)


def test_whatever_the_priors_say_an_accepted_pose_is_the_true_one(hall: Any) -> None:
    accepted = 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        truth = Pose(Rotation.random(random_state=seed).as_matrix(), rng.normal(size=3) * 3.0)
        count = int(rng.choice([1, 3]))
        share = rng.uniform(0.12, 0.9)
        per_camera = int(rng.integers(60, 200) / count)
        images = []
        for i, cam_from_rig in enumerate(RIG[:count]):
            right = int(share * per_camera)
            matches = hall.matches(
                cam_from_rig @ truth, right, per_camera - right, seed=100 * seed + i
            )
            images.append(hall.image(matches, sensor=str(i), cam_from_rig=cam_from_rig))
        solved = solve(images, hall, some_prior(rng, hall.to_world(truth)))
        pose = solved.answer.pose
        if pose is None:
            continue
        accepted += 1
        shift = np.abs(pose.rig_from_world.center - hall.to_world(truth).center)
        turn = Rotation.from_matrix(pose.rig_from_world.rotation @ truth.rotation.T)
        assert (shift < 5.0 * pose.position_std).all(), seed
        assert (np.abs(turn.as_rotvec()) < 5.0 * pose.orientation_std).all(), seed
    assert 25 < accepted < 80


def test_with_a_twin_a_lying_prior_never_makes_its_minority_an_answer(hall: Any) -> None:
    # The photo shows TRUTH with 100 matches, and by chance 55 fit another pose.
    for seed in range(20):
        image, majority = twins(hall, here=55, there=100, seed=seed)
        rng = np.random.default_rng(seed)
        priors = replace(
            some_prior(rng, hall.to_world(TRUTH)),
            pose=pose_prior(hall.to_world(TRUTH), 0.02, 0.2),
        )
        solved = solve([image], hall, priors)
        if solved.answer.pose is not None:
            assert error_of(solved, hall, majority) < (0.1, 0.5)


# Few inliers


def street(place: Any, seed: int, noise: float) -> Matches:
    """45 right and 300 wrong matches in a narrow band of the photo, of a camera at the origin."""
    rng = np.random.default_rng(seed)
    band = np.column_stack([rng.uniform(5, 635, 345), rng.normal(240, 15, 345)])
    other = np.column_stack([rng.uniform(5, 635, 345), rng.normal(240, 15, 345)])
    pixels = np.where(np.arange(345)[:, None] < 45, band, other)
    points = normalized_rays(place.camera, pixels) * rng.uniform(20, 60, (345, 1))
    return Matches(band + noise * rng.normal(size=band.shape), points)


def test_of_blurred_photos_a_pose_that_halves_do_not_confirm_is_refused(place: Any) -> None:
    refused, worst = 0, 0.0
    for seed in range(12):
        images = [place.image(street(place, seed, noise=6.0))]
        solved = solve(images, place)
        insisted = solve(images, place, min_inliers=29)
        if solved.answer.pose is None:
            assert reason(solved) is Reason.UNCERTAIN_POSE
            refused += 1
            if insisted.answer.pose is not None:
                worst = max(worst, error_of(insisted, place, Pose.identity())[0])
    assert refused >= 4
    assert worst > 1.0


def test_only_who_asks_for_fewer_inliers_than_the_default_does_without_the_halves(
    place: Any,
) -> None:
    for seed in range(4):
        images = [place.image(street(place, seed, noise=6.0))]
        assert reason(solve(images, place, min_inliers=30)) is reason(solve(images, place))
        assert reason(solve(images, place, min_inliers=29)) is not Reason.UNCERTAIN_POSE


def test_of_sharp_photos_the_same_few_inliers_are_enough(place: Any) -> None:
    for seed in range(12):
        images = [place.image(street(place, seed, noise=0.5))]
        assert error_of(solve(images, place), place, Pose.identity()) < (0.5, 1.0)


def test_the_whole_uncertainty_and_the_photos_part_are_told_apart(place: Any) -> None:
    geometry = place.geometry
    geometry.errors = MapErrors(5.0, 3.0)
    root = 0.01 * np.random.default_rng(0).normal(size=(6, 6))
    found = Pose(np.eye(3), np.array([1.0, 2.0, 3.0]))

    pose = measured_pose(GeneralizedPose(found, (), None), root @ root.T, geometry)

    assert pose.uncertainty is Uncertainty.WHOLE
    assert pose.photo_covariance is not None
    whole, photo = (
        center_covariance(pose.rig_from_world, one)
        for one in (pose.covariance, pose.photo_covariance)
    )
    assert whole[3:, 3:] == pytest.approx(25.0 * photo[3:, 3:], rel=1e-6)
    assert whole[:3, :3] == pytest.approx(9.0 * photo[:3, :3])
    assert pose.position_std == pytest.approx(np.sqrt(np.diag(whole)[3:]), rel=1e-6)
    assert pose.orientation_std == pytest.approx(np.sqrt(np.diag(whole)[:3]))
