from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tests.visloc.localization.acceptance.test_judge import SLACK, localized, of
from visloc.errors import InvalidInput
from visloc.geometry import Camera, Pose, Similarity
from visloc.localization.acceptance.judge import Tie, judge
from visloc.localization.map_view.constraints import Constraints
from visloc.options import ReadAs
from visloc.pose.covariance import mahalanobis2
from visloc.pose.motion import moved_pose, position_covariance
from visloc.priors import (
    NO_PRIORS,
    GnssPrior,
    GravityPrior,
    HeightBand,
    PosePrior,
    PositionPrior,
    Priors,
)
from visloc.types import (
    CameraSource,
    Candidate,
    Evidence,
    ImageAnswer,
    InstantAnswer,
    PoseSource,
    Reason,
    Refusal,
    RigPose,
    Uncertainty,
)
from visloc_extensions.sets.frame import answer_in_set, priors_in_tile, scaled_device

RANDOM = np.random.default_rng(0)
SET_FROM_TILE = Similarity(
    2.5, Rotation.from_rotvec([0.3, -1.2, 0.4]).as_matrix(), np.array([30.0, -400.0, 7.0])
)
CAM_FROM_TILE = Pose(Rotation.from_rotvec([0.1, 0.2, -2.0]).as_matrix(), np.array([3.0, 1.0, 8.0]))
ROOT = RANDOM.normal(size=(6, 6)) * 0.01
COVARIANCE = ROOT @ ROOT.T
CAMERA = Camera("PINHOLE", 64, 48, (50.0, 50.0, 32.0, 24.0))
EVIDENCE = Evidence(CAMERA, CameraSource.GIVEN, 1, ReadAs.STORED)
RIG_POSE = RigPose(
    CAM_FROM_TILE,
    COVARIANCE,
    np.sqrt(np.diag(position_covariance(CAM_FROM_TILE, COVARIANCE))),
    np.sqrt(np.diag(COVARIANCE)[:3]),
    PoseSource.ESTIMATED,
    COVARIANCE / 4,
    Uncertainty.WHOLE,
)
CAM_FROM_RIG = Pose(np.eye(3), np.array([0.5, 0.0, 0.0]))
ANSWER = InstantAnswer(7, (ImageAnswer("cam", CAM_FROM_RIG, EVIDENCE, None),), RIG_POSE, None, {})
POINTS = RANDOM.normal(size=(9, 3))


def moved_rig(answer: InstantAnswer, set_from_tile: Similarity = SET_FROM_TILE) -> RigPose:
    pose = answer_in_set(answer, set_from_tile, "floors@v1").pose
    assert pose is not None
    return pose


def perturbed(pose: Pose, by: NDArray[np.float64]) -> Pose:
    turn = Rotation.from_rotvec(by[:3]).as_matrix()
    return Pose(turn @ pose.rotation, pose.translation + by[3:])


def test_points_and_camera_move_together() -> None:
    moved = moved_rig(ANSWER).rig_from_world

    np.testing.assert_allclose(
        moved.apply(SET_FROM_TILE.apply(POINTS)),
        SET_FROM_TILE.scale * CAM_FROM_TILE.apply(POINTS),
        atol=1e-9,
    )
    np.testing.assert_allclose(moved.center, SET_FROM_TILE.apply(CAM_FROM_TILE.center), atol=1e-9)


def test_a_covariance_moves_as_the_pose_it_belongs_to() -> None:
    pose, covariance = moved_pose(CAM_FROM_TILE, COVARIANCE, SET_FROM_TILE)

    step = 1e-6
    columns = []
    for axis in np.eye(6):
        there = SET_FROM_TILE.move(perturbed(CAM_FROM_TILE, step * axis))
        turned = Rotation.from_matrix(there.rotation @ pose.rotation.T).as_rotvec()
        columns.append(np.concatenate([turned, there.translation - pose.translation]) / step)
    jacobian = np.array(columns).T
    np.testing.assert_allclose(covariance, jacobian @ COVARIANCE @ jacobian.T, rtol=1e-3)


def test_standard_deviations_scale_with_the_unit_and_turn_with_the_axes() -> None:
    moved = moved_rig(ANSWER)

    expected = position_covariance(moved.rig_from_world, moved.covariance)
    np.testing.assert_allclose(moved.position_std, np.sqrt(np.diag(expected)), rtol=1e-6)
    np.testing.assert_array_equal(moved.orientation_std, RIG_POSE.orientation_std)


def test_an_answer_moved_there_and_back_is_what_it_was() -> None:
    back = moved_rig(answer_in_set(ANSWER, SET_FROM_TILE, "floors@v1"), SET_FROM_TILE.inverse())

    np.testing.assert_allclose(back.rig_from_world.translation, CAM_FROM_TILE.translation)
    np.testing.assert_allclose(back.covariance, COVARIANCE, rtol=1e-6, atol=1e-12)


def test_a_rig_moves_with_its_cameras() -> None:
    moved = answer_in_set(ANSWER, SET_FROM_TILE, "floors@v1")

    assert moved.pose is not None
    cam_from_set = moved.images[0].cam_from_rig @ moved.pose.rig_from_world
    expected = SET_FROM_TILE.move(CAM_FROM_RIG @ CAM_FROM_TILE)
    np.testing.assert_allclose(cam_from_set.translation, expected.translation)
    assert answer_in_set(replace(ANSWER, pose=None), SET_FROM_TILE, "floors@v1").pose is None
    # A rig that is sent is in the set's unit.
    sent = scaled_device(moved.images[0].cam_from_rig, SET_FROM_TILE.inverse().scale)
    np.testing.assert_allclose(sent.translation, CAM_FROM_RIG.translation)


def test_priors_say_the_same_of_a_place_in_both_frames() -> None:
    place = RANDOM.normal(size=3) * 10
    in_set = SET_FROM_TILE.apply(place)
    down = SET_FROM_TILE.rotation @ np.array([0.0, 0.0, -1.0])
    height = float(-down @ in_set)
    pose, covariance = moved_pose(CAM_FROM_TILE, COVARIANCE, SET_FROM_TILE)

    priors = priors_in_tile(
        Priors(
            position=PositionPrior(in_set, 5.0),
            height=HeightBand(height - 1.0, height + 2.0),
            pose=PosePrior(pose, covariance),
            gravity=GravityPrior(np.array([0.0, 1.0, 0.0]), 0.02, down),
            maps=("room",),
        ),
        SET_FROM_TILE,
        None,
    )

    assert priors.position is not None
    np.testing.assert_allclose(priors.position.position, place, atol=1e-9)
    assert priors.position.radius == pytest.approx(2.0)
    assert priors.height is not None
    # In the tile, z is up.
    assert (priors.height.min, priors.height.max) == pytest.approx((place[2] - 0.4, place[2] + 0.8))
    assert priors.pose is not None
    there = Pose(CAM_FROM_TILE.rotation, CAM_FROM_TILE.translation + 0.02)
    assert mahalanobis2(
        priors.pose.device_from_world, priors.pose.covariance, there, COVARIANCE
    ) == pytest.approx(mahalanobis2(CAM_FROM_TILE, COVARIANCE, there, COVARIANCE), rel=1e-6)
    assert priors.gravity is not None
    assert priors.gravity.world is not None
    np.testing.assert_allclose(priors.gravity.world, [0, 0, -1], atol=1e-9)
    assert priors.maps is None


def test_a_fix_allows_the_same_places_in_both_frames() -> None:
    fix_from_set = Similarity(0.5, SET_FROM_TILE.rotation, np.array([3.0, -4.0, 5.0]))
    fix = GnssPrior(48.0, 8.0, 0.5, 400.0, 1.0, fix_from_set)
    moved = priors_in_tile(Priors(gnss=fix), SET_FROM_TILE, None).gnss
    assert moved is not None
    points = RANDOM.normal(size=(20, 3)) * 10
    np.testing.assert_allclose(moved.beyond(points), fix.beyond(SET_FROM_TILE.apply(points)))


def test_down_of_the_set_serves_a_height_band() -> None:
    moved = priors_in_tile(
        Priors(height=HeightBand(10.0, 13.0)),
        Similarity(1.0, np.eye(3), np.array([0.0, 0.0, 9.0])),
        np.array([0.0, 0.0, -1.0]),
    )

    assert moved.height == HeightBand(1.0, 4.0, (0.0, 0.0, -1.0))


def test_a_floor_far_from_the_origin_of_a_tilted_tile_is_the_floor_of_the_set(
    place: Any, hall: Any
) -> None:
    """What a tile takes for down, 4 degrees off, is 7 higher at 100 from its origin."""
    tilt = Rotation.from_rotvec([np.radians(4.0), 0, 0]).as_matrix()
    set_from_tile = Similarity(1.0, tilt, np.array([0.0, 3.0, -1.0]))
    floors = np.array([[0.0, 100.0, 2.0], [0.0, 100.0, 9.0]])
    centers = set_from_tile.inverse().apply(floors)
    down = np.array([0.0, 0.0, -1.0])
    priors = priors_in_tile(Priors(height=HeightBand(1.0, 3.0)), set_from_tile, down)

    for one in (replace(hall, origin=place.origin), place):  # the other knows no down at all
        constraints = Constraints(one.geometry_of(centers), priors)
        assert constraints.photo_weights is not None
        assert constraints.photo_weights.tolist() == [1.0, 0.0]
        right, wrong = (Pose(np.eye(3), -center) for center in centers)
        assert constraints.contradiction(right, 1e-6 * np.eye(6)) is None
        assert "its height is" in str(constraints.contradiction(wrong, 1e-6 * np.eye(6)))


def test_a_height_band_without_any_down_is_refused() -> None:
    with pytest.raises(InvalidInput, match="down direction") as caught:
        priors_in_tile(Priors(height=HeightBand(0.0, 3.0)), SET_FROM_TILE, None)

    assert caught.value.code == "priors.height"


def test_no_priors_stay_none() -> None:
    assert priors_in_tile(NO_PRIORS, SET_FROM_TILE, None).position is None


def test_candidates_of_a_refusal_move_and_name_the_set_and_the_tile() -> None:
    places = (Candidate(CAM_FROM_TILE, 40, "floor@v1", image="a.jpg", preference=0.5),)
    refused = replace(
        ANSWER, pose=None, refusal=Refusal("gate", Reason.AMBIGUOUS, "two doors", places)
    )

    refusal = answer_in_set(refused, SET_FROM_TILE, "floors@v1").refusal

    assert refusal is not None
    (moved,) = refusal.candidates
    np.testing.assert_allclose(
        moved.rig_from_world.center, SET_FROM_TILE.apply(CAM_FROM_TILE.center), atol=1e-9
    )
    assert (moved.map, moved.tile, moved.image) == ("floors@v1", "floor@v1", "a.jpg")


def test_poses_are_compared_in_one_frame_and_unit() -> None:
    turn = Rotation.from_euler("zyx", [40, -20, 10], degrees=True).as_matrix()
    b_from_a = Similarity(2.5, turn, np.array([30.0, -4.0, 7.0]))
    here = localized(200, (1.0, 2.0, 3.0), turn=0.4)
    there = answer_in_set(localized(190, (1.2, 2.0, 3.0), turn=0.4), b_from_a, "set@v1")
    elsewhere = answer_in_set(localized(190, (1.6, 2.0, 3.0), turn=0.4), b_from_a, "set@v1")

    def tied(a: int, _: int) -> Tie:
        return Tie(b_from_a.inverse() if a == 0 else b_from_a, SLACK if a == 0 else 2.5 * SLACK)

    assert judge(of(here, there), tied) == 0
    assert judge(of(there, here), lambda a, b: tied(b, a)) == 1
    assert isinstance(judge(of(here, elsewhere), tied), Refusal)
    pose, unmoved = there.pose, localized(190, (1.2, 2.0, 3.0), turn=0.4).pose
    assert pose is not None
    assert unmoved is not None
    back, covariance = moved_pose(pose.rig_from_world, pose.covariance, b_from_a.inverse())
    assert np.allclose(back.center, (1.2, 2.0, 3.0))
    assert np.allclose(covariance, unmoved.covariance)
