from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.visloc.localization.map_view.test_constraints import Building, assert_on
from visloc.archive import MapStore
from visloc.geometry import Pose
from visloc.localization.acceptance.preference import SURE, preference
from visloc.localization.acceptance.rivals import score
from visloc.localization.localizer import Localizer
from visloc.localization.solving import SeenImage, Solved
from visloc.options import LocalizeOptions, Matcher
from visloc.priors import NO_PRIORS, Priors
from visloc.types import CameraSource, Localized, NotLocalized, Reason


@pytest.fixture(scope="module")
def room(built_maps: Any) -> Localizer:
    from visloc.features import make_local_features

    return Localizer(MapStore(built_maps).open("room"), make_local_features("sift"))


def test_chance_matches_count_nothing_on_average_and_right_ones_count() -> None:
    rng = np.random.default_rng(0)
    by_chance = np.sqrt(rng.uniform(0, 1, 100_000))  # spread evenly over the disc

    assert score(by_chance).mean() == pytest.approx(0.0, abs=0.005)
    assert (score(np.array([0.0, 0.1, 0.3])) == 1.0).all()
    assert (score(np.array([1.01, np.inf])) == 0.0).all()


def test_preference_is_standard_normal_where_nothing_tells_and_grows_with_evidence() -> None:
    rng = np.random.default_rng(0)
    scores = score(np.sqrt(rng.uniform(0, 4, (2, 2000, 200))))
    found = [preference(a, b) for a, b in zip(*scores, strict=True)]
    assert np.mean(found) == pytest.approx(0.0, abs=0.1)
    assert np.std(found) == pytest.approx(1.0, abs=0.1)

    same, sign, none = np.ones(500), np.ones(20), np.zeros(20)
    with_sign, without = np.concatenate([same, sign]), np.concatenate([same, none])
    assert preference(with_sign, without) == pytest.approx(np.sqrt(20))
    assert preference(without, with_sign) == -preference(with_sign, without)
    assert preference(same, same) == 0.0
    assert preference(np.empty(0), np.empty(0)) == 0.0


@pytest.mark.parametrize("floor", [0, 1])
def test_identical_places_are_refused_with_both_named(
    room: Localizer, place: Any, floor: int
) -> None:
    answer = Building(room, 0.0, 0.0).ask(place, floor, NO_PRIORS)

    assert isinstance(answer, NotLocalized)
    assert (answer.stage, answer.reason) == ("gate", Reason.AMBIGUOUS)
    for candidate in (0, 1):
        z = Building.pose(candidate, 2.2).center[2]
        assert f"{z:.1f}" in answer.message
    assert answer.message.count("inliers in") == 2


@pytest.mark.parametrize("floor", [0, 1])
def test_candidates_are_the_poses_on_both_floors(room: Localizer, place: Any, floor: int) -> None:
    building = Building(room, 0.0, 0.0)
    answer = building.ask(place, floor, NO_PRIORS)

    assert isinstance(answer, NotLocalized)
    assert len(answer.candidates) == 2
    places = sorted(answer.candidates, key=lambda each: each.rig_from_world.center[2])
    for on, each in enumerate(places):
        expected = Building.pose(on, 2.2)
        np.testing.assert_allclose(each.rig_from_world.center, expected.center, atol=0.05)
        np.testing.assert_allclose(each.rig_from_world.rotation, expected.rotation, atol=0.01)
    first, second = answer.candidates
    assert first.num_inliers >= second.num_inliers > 30
    assert first.preference is not None
    assert second.preference is not None
    assert first.preference == -second.preference
    assert abs(first.preference) < SURE
    names = {image.name for image in building.localizer.map.images}
    assert {first.image, second.image} <= names
    assert {each.map for each in answer.candidates} == {building.localizer.map.ref}
    assert {each.tile for each in answer.candidates} == {None}


@pytest.mark.parametrize("top_k", [2, 3, 16])
@pytest.mark.parametrize("floor", [0, 1])
def test_however_many_photos_are_searched_identical_places_are_told_from_no_other(
    room: Localizer, place: Any, floor: int, top_k: int
) -> None:
    """With two, all that show one place are among the nearest to the photo of the other."""
    answer = Building(room, 0.0, 0.0).ask(place, floor, NO_PRIORS, top_k)

    assert isinstance(answer, NotLocalized)
    assert answer.reason is Reason.AMBIGUOUS


@pytest.mark.parametrize("floor", [0, 1])
def test_a_sign_decides_between_places_that_are_otherwise_identical(
    room: Localizer, place: Any, floor: int
) -> None:
    assert_on(Building(room, 0.5, 0.5).ask(place, floor, NO_PRIORS), floor)


@pytest.mark.parametrize("floor", [0, 1])
def test_where_retrieval_is_a_coin_toss_the_wrong_place_is_never_the_answer(
    room: Localizer, place: Any, floor: int
) -> None:
    answer = Building(room, 0.3, 0.0).ask(place, floor, NO_PRIORS)

    if isinstance(answer, NotLocalized):
        assert answer.reason is Reason.AMBIGUOUS
    else:
        assert_on(answer, floor)


@pytest.mark.parametrize("floor", [0, 1])
def test_a_prior_that_excludes_one_of_two_identical_places_decides(
    room: Localizer, place: Any, floor: int
) -> None:
    building = Building(room, 0.0, 0.0)

    assert_on(building.ask(place, floor, Priors(height=building.band(floor))), floor)


def rig_beside(building: Building, place: Any, other: str) -> Solved:
    """Two cameras: one sees a floor, the other nothing, or the same with a camera that is a guess.

    A rig leaves out cameras that are a guess.
    """
    options = LocalizeOptions(top_k=4, min_inliers=15)
    features = building.features(place, 0)
    none = replace(features, keypoints=features.keypoints[:0], descriptors=features.descriptors[:0])
    sees = building.localizer.look_at_features(features, place.camera, options)
    if other == "blank":
        beside = building.localizer.look_at_features(none, place.camera, options)
    else:
        evidence = replace(sees.evidence, camera_source=CameraSource.GUESS)
        beside = replace(sees, evidence=evidence)
    looks = {"cam0": sees, "cam1": beside}
    images = [SeenImage(sensor, Pose.identity(), look) for sensor, look in looks.items()]
    return building.localizer.solve(images, options)


@pytest.mark.parametrize("other", ["blank", "guess"])
def test_a_camera_that_shows_nothing_does_not_hide_a_second_place(
    room: Localizer, place: Any, other: str
) -> None:
    refusal = rig_beside(Building(room, 0.0, 0.0), place, other).answer.refusal
    assert refusal is not None
    assert refusal.reason is Reason.AMBIGUOUS


def test_a_camera_that_was_left_out_speaks_for_no_place(room: Localizer, place: Any) -> None:
    building = Building(room, 0.5, 0.5)
    num = len(building.features(place, 0).keypoints)
    scores = rig_beside(building, place, "guess").answer.scores
    assert scores[:num].any()
    assert len(scores) == 2 * num
    assert not scores[num:].any()


def test_a_single_keypoint_decides_nothing() -> None:
    assert preference(np.array([1.0]), np.array([0.0])) < SURE


def rig_of_two(building: Building, place: Any, floor: int, *, signs: bool) -> Solved:
    """Two cameras that look apart by a right angle; the first one sees no sign."""
    options = LocalizeOptions(top_k=4, min_inliers=15)
    rig_from_world = building.pose(0, 2.2)
    images = []
    for sensor, photo in (("cam0", 2.2), ("cam1", 4.2)):
        features = building.features(place, floor, photo, signs=signs and sensor == "cam1")
        look = building.localizer.look_at_features(features, place.camera, options)
        cam_from_rig = building.pose(0, photo) @ rig_from_world.inverse()
        images.append(SeenImage(sensor, cam_from_rig, look))
    return building.localizer.solve(images, options)


@pytest.mark.parametrize("floor", [0, 1])
def test_a_rig_in_one_of_two_identical_rooms_is_refused_with_both_poses_of_the_rig(
    room: Localizer, place: Any, floor: int
) -> None:
    refusal = rig_of_two(Building(room, 0.0, 0.0), place, floor, signs=True).answer.refusal

    assert refusal is not None
    assert refusal.reason is Reason.AMBIGUOUS
    places = sorted(refusal.candidates, key=lambda each: each.rig_from_world.center[2])
    assert len(places) == 2
    for on, each in enumerate(places):
        expected = Building.pose(on, 2.2)
        np.testing.assert_allclose(each.rig_from_world.center, expected.center, atol=0.05)
        np.testing.assert_allclose(each.rig_from_world.rotation, expected.rotation, atol=0.01)
    # Nothing tells the floors apart, and keypoints of both cameras count.
    assert [each.preference for each in places] == [0.0, 0.0]
    alone = Building(room, 0.0, 0.0).ask(place, floor, NO_PRIORS)
    assert isinstance(alone, NotLocalized)
    assert places[0].num_inliers > alone.candidates[0].num_inliers


@pytest.mark.parametrize("floor", [0, 1])
def test_a_sign_that_one_camera_of_a_rig_sees_decides_for_both(
    room: Localizer, place: Any, floor: int
) -> None:
    building = Building(room, 0.6, 0.0)

    unsigned = rig_of_two(building, place, floor, signs=False).answer
    signed = rig_of_two(building, place, floor, signs=True).answer

    assert unsigned.refusal is not None
    assert unsigned.refusal.reason is Reason.AMBIGUOUS
    assert [each.preference for each in unsigned.refusal.candidates] == [0.0, 0.0]
    right = Building.pose(floor, 2.2).center
    if signed.pose is not None:
        np.testing.assert_allclose(signed.pose.rig_from_world.center, right, atol=0.05)
        return
    # The votes of the identical rest all went to the other floor: too few matches are left.
    assert signed.refusal is not None
    likelier = max(signed.refusal.candidates, key=lambda each: each.preference or 0.0)
    np.testing.assert_allclose(likelier.rig_from_world.center, right, atol=0.05)
    assert likelier.preference is not None
    assert likelier.preference > SURE


def test_further_photos_are_matched_with_the_ratio_of_the_query(
    room: Localizer, place: Any
) -> None:
    building = Building(room, 0.0, 0.0)
    features, other = building.features(place, 0), np.array([1, 2, 9, 10])
    # Each keypoint looks nearly as much like the next one's landmark.
    mixed = features.descriptors + 0.95 * np.roll(features.descriptors, 1, axis=0)
    features = replace(features, descriptors=mixed)
    found = {}
    for matcher in (Matcher.MUTUAL, Matcher.RATIO):
        options = LocalizeOptions(top_k=1, matcher=matcher)
        proposed = building.localizer.look_at_features(features, place.camera, options).proposed
        assert proposed is not None
        more = proposed.matched_with(other, building.localizer.geometry)
        all_of_them = LocalizeOptions(top_k=16, matcher=matcher)
        whole = building.localizer.look_at_features(features, place.camera, all_of_them).proposed
        assert whole is not None
        for row, photo in enumerate(more.photos):
            (rank,) = np.flatnonzero(whole.photos == photo)
            ours, theirs = more.pairs.ranks == row, whole.pairs.ranks == rank
            assert set(more.pairs.keypoints[ours]) == set(whole.pairs.keypoints[theirs])
        found[matcher] = len(more.pairs.keypoints)
    assert found[Matcher.RATIO] < found[Matcher.MUTUAL]


@pytest.mark.parametrize(("num_alike", "is_rival"), [(75, False), (150, True)])
def test_a_place_that_would_be_no_answer_alone_is_no_rival(
    room: Localizer, place: Any, num_alike: int, is_rival: bool
) -> None:
    """On the other floor most landmarks stand elsewhere; those that do not are seen sharply.

    All others are blurred, so that they speak for the right floor no more than chance. Of the sharp
    ones the photo shows 16 or 31, and a pose needs 20 inliers.
    """
    building = Building(room, 0.0, 0.0)
    features, rng = building.features(place, 0), np.random.default_rng(3)
    landmarks = building.landmarks.copy()
    landmarks[1, num_alike:] = rng.permutation(landmarks[1, num_alike:])
    alike = (features.descriptors[:, None] == building.descriptors[0, :num_alike]).all(2).any(1)
    radii, angles = 11 * np.sqrt(rng.uniform(size=len(alike))), rng.uniform(0, 6.28, len(alike))
    blur = np.column_stack([radii * np.cos(angles), radii * np.sin(angles)]) * ~alike[:, None]
    localizer = Localizer(
        replace(building.localizer.map, landmarks=landmarks.reshape(-1, 3).astype(np.float32)), None
    )
    answer = localizer.localize_features(
        replace(features, keypoints=np.clip(features.keypoints + blur, 0, [640, 480])),
        place.camera,
        LocalizeOptions(min_inliers=20),
    )
    assert (alike.sum() < 20) != is_rival
    if is_rival:
        assert isinstance(answer, NotLocalized)
        assert answer.reason is Reason.AMBIGUOUS
    else:
        assert isinstance(answer, Localized)
