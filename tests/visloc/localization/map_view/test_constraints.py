from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from visloc.archive import MapStore
from visloc.archive.schema import Parts
from visloc.errors import InvalidInput
from visloc.evaluation import pose_error
from visloc.geometry import Camera, Pose, Similarity, covariance_from_center
from visloc.localization.localizer import Localizer
from visloc.localization.map_view.constraints import Constraints, MapGeometry
from visloc.options import LocalizeOptions
from visloc.pose.reprojection import MatchedView, normalized_rays, project
from visloc.priors import (
    NO_PRIORS,
    GnssPrior,
    GravityPrior,
    HeightBand,
    PosePrior,
    PositionPrior,
    Priors,
    check_covariance,
)
from visloc.retrieval.index import GlobalRows
from visloc.types import Answer, Localized, NotLocalized, QueryFeatures, Reason

TURNED = Pose(Rotation.from_rotvec([0.3, -1.2, 0.4]).as_matrix(), np.array([1.0, -2.0, 0.5]))


# Where photos were taken and how far they see


def test_centres_are_told_relative_to_the_origin_without_losing_digits(far_place: Any) -> None:
    origin = far_place.origin
    quaternion = TURNED.rotation_wxyz
    world = far_place.to_world(TURNED)
    opened: Any = SimpleNamespace(
        manifest=SimpleNamespace(world=SimpleNamespace(origin=tuple(origin)), parts=Parts()),
        gravity=None,
        has_landmarks=True,
        image_poses=np.array([[*quaternion, *world.translation]]),
    )
    assert MapGeometry(opened).centers == pytest.approx(TURNED.center[None], abs=1e-8)


def test_the_reach_is_the_median_distance_to_what_photos_see(place: Any) -> None:
    geometry = place.geometry_of([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0]])
    assert geometry.reach == pytest.approx(5.0)


def test_a_map_whose_photos_see_nothing_has_no_reach_and_can_be_searched(place: Any) -> None:
    geometry = place.geometry_of([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0]])
    geometry.opened.observation_offsets = np.zeros(3, dtype=np.int64)
    assert geometry.reach == 0.0
    prior = Priors(PositionPrior(np.zeros(3), 1.0))
    assert Constraints(geometry, prior).photo_weights == pytest.approx([1.0, 0.0])


# Which photos are searched

LINE = [[float(x), 0.0, 0.0] for x in range(0, 30, 3)]  # the photos of ``place`` see 5 far


def test_without_an_area_all_photos_count_the_same(hall: Any) -> None:
    geometry = hall.geometry_of(LINE)
    assert Constraints(geometry, NO_PRIORS).photo_weights is None
    gravity = Priors(gravity=GravityPrior(np.array([0.0, 1.0, 0.0]), 0.02))
    assert Constraints(geometry, gravity).photo_weights is None


def test_photos_count_less_the_further_they_are_outside_the_area(far_place: Any) -> None:
    prior = PositionPrior(far_place.origin + np.array([0.5, 0.0, 0.0]), 7.0)
    weights = Constraints(far_place.geometry_of(LINE), Priors(prior)).photo_weights
    assert weights is not None
    # Within 7 of 0.5 all count fully; beyond by more than twice the reach of 5, not at all.
    assert (weights[:3] == 1.0).all()
    assert (np.diff(weights[2:6]) < 0).all()
    assert weights[3] == pytest.approx(np.exp(-0.5 * (1.5 / 5.0) ** 2))
    assert (weights[:6] > 0).all()
    assert (weights[6:] == 0).all()


def test_areas_of_several_priors_are_searched_where_they_overlap(far_place: Any) -> None:
    geometry = far_place.geometry_of(LINE)
    left = PositionPrior(far_place.origin, 1.0)
    at_end = Pose(np.eye(3), -(far_place.origin + np.array([27.0, 0.0, 0.0])))
    right = PosePrior(at_end, np.diag([1e-20] * 3 + [0.01] * 3))
    for priors in (Priors(position=left), Priors(pose=right)):
        weights = Constraints(geometry, priors).photo_weights
        assert weights is not None
        assert weights.max() == 1.0
    both = Constraints(geometry, Priors(position=left, pose=right)).photo_weights
    assert both is not None
    assert not both.any()


def test_a_pose_prior_searches_three_standard_deviations_along_its_worst_axis(place: Any) -> None:
    spread = np.diag([1e-6] * 3 + [1.0, 4.0, 0.01])
    for axis in np.eye(3):
        prior = PosePrior(Pose(np.eye(3), np.zeros(3)), spread)
        weights = Constraints(
            place.geometry_of([5.9 * axis, 6.1 * axis]), Priors(pose=prior)
        ).photo_weights
        assert weights is not None
        assert weights[0] == 1.0 > weights[1] > 0.99


def test_the_floors_above_and_below_are_not_searched(hall: Any) -> None:
    # Floors are 3 apart, photos are taken at eye height.
    for eye in (0.8, 1.5, 1.6, 2.2):
        centers = [[0.0, 0.0, 3.0 * floor + eye] for floor in range(-2, 3)]
        weights = Constraints(
            hall.geometry_of(centers), Priors(height=HeightBand(0.0, 3.0))
        ).photo_weights
        assert weights is not None
        assert weights.tolist() == [0.0, 0.0, 1.0, 0.0, 0.0]


def test_a_photo_a_little_outside_the_band_is_searched_too(hall: Any) -> None:
    centers = [[0.0, 0.0, height] for height in (-0.7, -0.5, 3.5, 3.7)]
    weights = Constraints(
        hall.geometry_of(centers), Priors(height=HeightBand(0.0, 3.0))
    ).photo_weights
    assert weights is not None
    assert weights.all()


@pytest.mark.parametrize(
    "priors",
    [
        Priors(PositionPrior(np.full(3, 1e15), 1e-300)),
        Priors(PositionPrior(np.full(3, -1e15), 1e15)),
        Priors(PositionPrior(np.array([1e6, 1e6, 0.0]), 1e15)),
        Priors(height=HeightBand(-1e308, 1e308)),
        Priors(height=HeightBand(1e300, 1e308)),
        Priors(pose=PosePrior(Pose(np.eye(3), np.full(3, 1e15)), np.diag([1e15] * 6))),
        Priors(pose=PosePrior(TURNED, np.diag([1e-300] * 6))),
    ],
)
def test_weights_are_between_0_and_1_whatever_the_size_of_a_prior(
    hall: Any, priors: Priors
) -> None:
    weights = Constraints(hall.geometry_of(LINE), priors).photo_weights
    assert weights is not None
    assert ((weights >= 0) & (weights <= 1)).all()


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    center=st.lists(st.floats(-1e4, 1e4), min_size=3, max_size=3),
    radius=st.floats(1e-6, 1e4),
    larger=st.floats(1.0, 10.0),
)
def test_a_larger_area_never_makes_a_photo_count_less(
    center: list[float], radius: float, larger: float
) -> None:
    rng = np.random.default_rng(0)
    geometry: Any = SimpleNamespace(
        origin=np.zeros(3), down=None, centers=rng.normal(size=(50, 3)) * 100.0, reach=7.0
    )
    small, large = (
        Constraints(geometry, Priors(PositionPrior(np.array(center), r))).photo_weights
        for r in (radius, radius * larger)
    )
    assert small is not None
    assert large is not None
    assert (large >= small).all()
    assert ((small >= 0) & (large <= 1)).all()
    inside = np.linalg.norm(geometry.centers - center, axis=1) <= radius
    assert (small[inside] == 1.0).all()


# Which poses are refused


def at(height: float) -> Pose:
    """A pose of this height, relative to the origin."""
    return Pose(TURNED.rotation, -TURNED.rotation @ [0.0, 0.0, height])


def spread(std: float) -> NDArray[np.float64]:
    """Covariance of a pose whose translation is known to ``std``, its rotation exactly."""
    return np.diag([1e-12] * 3 + [std**2] * 3)


def test_what_contradicts_is_said_with_numbers(hall: Any) -> None:
    pose = at(4.0)
    covariance = spread(0.01)
    world = hall.to_world(pose)

    def said(priors: Priors) -> str:
        return Constraints(hall.geometry, priors).contradiction(pose, covariance) or ""

    assert said(NO_PRIORS) == ""
    assert said(Priors(PositionPrior(world.center + np.array([2.0, 0, 0]), 1.0))) == (
        "it lies 2.00 from the prior position, but at most 1 is allowed"
    )
    assert (
        said(Priors(height=HeightBand(0.0, 3.0))) == "its height is 4.00, but the prior says 0 to 3"
    )
    down = Rotation.from_euler("x", 20, degrees=True).apply(pose.rotation @ hall.down)
    words = said(Priors(gravity=GravityPrior(down, np.radians(2.0))))
    assert words.startswith("its down direction is ")
    assert words.endswith("degrees from the prior gravity, but at most 6 is allowed")
    turned = Pose(np.eye(3), -world.center)
    words = said(Priors(pose=PosePrior(turned, np.diag([1e-4] * 3 + [1e14] * 3))))
    assert "degrees from the prior pose" in words


def test_a_fix_narrows_the_search_and_is_checked_afterwards(hall: Any) -> None:
    # A metre is two units. The fix is above (9, 0) of the line, and its height is unknown.
    above = hall.origin + np.array([9.0, 0.0, 77.0])
    fix_from_world = Similarity(0.5, np.eye(3), -0.5 * above)
    fix = GnssPrior(48.0, 8.0, 0.5, fix_from_world=fix_from_world)
    weights = Constraints(hall.geometry_of(LINE), Priors(gnss=fix)).photo_weights
    assert weights is not None
    x = np.array(LINE)[:, 0]
    beyond = np.maximum(np.abs(x - 9.0) - 3.0, 0.0) / 5.0  # photos see 5 far
    expected = np.where(beyond <= 2.0, np.exp(-0.5 * beyond**2), 0.0)
    assert weights == pytest.approx(expected)

    constraints = Constraints(hall.geometry, Priors(gnss=fix))
    assert constraints.narrow
    said = constraints.contradiction(Pose(np.eye(3), np.array([-5.0, 0, 0])), spread(0.01))
    assert said == "it lies 1.00 outside what the GNSS prior allows"
    assert constraints.contradiction(Pose(np.eye(3), np.array([-6.1, 0, 0])), spread(0.01)) is None
    assert constraints.contradiction(Pose(np.eye(3), np.array([-5.0, 0, 0])), spread(0.5)) is None


def test_a_pose_prior_is_compared_in_units_of_both_uncertainties(place: Any) -> None:
    pose = Pose(TURNED.rotation, np.zeros(3))
    prior = Priors(pose=PosePrior(pose, np.diag([1e-4] * 3 + [0.04] * 3)))
    constraints = Constraints(place.geometry, prior)
    for std, limit in ((1e-6, 5.28 * 0.2), (0.5, 5.28 * np.hypot(0.2, 0.5))):
        for away, contradicts in ((0.98 * limit, False), (1.02 * limit, True)):
            moved = Pose(pose.rotation, np.array([away, 0.0, 0.0]))
            said = constraints.contradiction(moved, spread(std))
            assert (said is not None) == contradicts


def test_near_a_pose_prior_only_what_it_explains_is_kept(place: Any) -> None:
    right = place.matches(TURNED, 80, 200, seed=3)
    view = MatchedView(place.camera, Pose.identity(), right.pixels, right.points)
    prior = Priors(pose=PosePrior(TURNED, np.diag([1e-4] * 3 + [1e-2] * 3)))
    near = Constraints(place.geometry, prior).near_pose_prior([view], 8.0)
    assert near is not None
    assert 80 <= len(near[0]) < 120
    assert np.array_equal(near[0].points[:80], view.points[:80])
    assert Constraints(place.geometry, NO_PRIORS).near_pose_prior([view], 8.0) is None
    # A landmark exactly where the camera should be is explained by nothing.
    view.points[0] = TURNED.center
    again = Constraints(place.geometry, prior).near_pose_prior([view], 8.0)
    assert again is not None
    assert len(again[0]) in (len(near[0]) - 1, len(near[0]))


@pytest.mark.parametrize("focal", [200.0, 500.0, 4000.0])
def test_without_a_focal_length_a_pose_prior_keeps_what_any_focal_length_explains(
    place: Any, focal: float
) -> None:
    camera = Camera("SIMPLE_PINHOLE", 640, 480, (focal, 320.0, 240.0))
    guess = Camera("SIMPLE_PINHOLE", 640, 480, (768.0, 320.0, 240.0))
    rng = np.random.default_rng(4)
    pixels = np.vstack([[[320.0, 240.0]], rng.uniform([0, 0], [640, 480], (279, 2))])
    points = TURNED.inverse().apply(
        normalized_rays(camera, pixels) * rng.uniform(2.0, 10.0, (280, 1))
    )
    points[80:] = TURNED.center + rng.uniform(-8.0, 8.0, (200, 3))
    prior = Priors(pose=PosePrior(TURNED, np.diag([1e-6] * 3 + [1e-6] * 3)))
    view = MatchedView(guess, Pose.identity(), pixels, points, focal_unknown=True)
    near = Constraints(place.geometry, prior).near_pose_prior([view], 4.0)
    assert near is not None
    assert np.array_equal(near[0].points[:80], points[:80])
    assert len(near[0]) < 100


# What cannot be a prior


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e16, -1e300])
def test_numbers_that_are_none_or_too_large_are_refused(bad: float) -> None:
    identity = Pose.identity()
    for make in (
        lambda: PositionPrior(np.array([0.0, bad, 0.0]), 1.0),
        lambda: PositionPrior(np.zeros(3), bad),
        lambda: PosePrior(Pose(np.eye(3), np.array([0.0, 0.0, bad])), np.eye(6)),
        lambda: PosePrior(Pose(np.full((3, 3), bad), np.zeros(3)), np.eye(6)),
        lambda: PosePrior(identity, np.diag([bad] * 6)),
    ):
        with pytest.raises(InvalidInput) as caught:
            make()
        assert caught.value.code.startswith(("priors.", "pose.covariance"))
        assert caught.value.expected
    if not np.isfinite(bad):
        for make_other in (
            lambda: HeightBand(bad, 3.0),
            lambda: HeightBand(0.0, bad),
            lambda: GravityPrior(np.array([0.0, bad, 1.0]), 0.02),
            lambda: GravityPrior(np.array([0.0, 0.0, 1.0]), 0.02, np.array([bad, 0.0, 0.0])),
            lambda: GravityPrior(np.array([0.0, 0.0, 1.0]), bad),
        ):
            with pytest.raises(InvalidInput):
                make_other()


@pytest.mark.parametrize("radius", [0.0, -1.0, -0.0])
def test_an_area_has_a_size(radius: float) -> None:
    with pytest.raises(InvalidInput) as caught:
        PositionPrior(np.zeros(3), radius)
    assert (caught.value.code, caught.value.field) == ("priors.position", "priors.position.radius")


def test_down_as_sent_must_be_down_as_the_map_knows_it(hall: Any) -> None:
    forward = np.array([0.0, 0.0, 1.0])
    tilted = np.array([np.sin(np.radians(4.0)), 0.0, -np.cos(np.radians(4.0))])
    assert Constraints(hall.geometry, Priors(gravity=GravityPrior(forward, 0.02, tilted))).gravity
    with pytest.raises(InvalidInput) as caught:
        Constraints(hall.geometry, Priors(gravity=GravityPrior(forward, 0.02, forward)))
    assert caught.value.field == "priors.gravity.world"


@pytest.mark.parametrize(("low", "high"), [(1.0, 1.0), (2.0, 1.0)])
def test_a_height_band_has_a_size(low: float, high: float) -> None:
    with pytest.raises(InvalidInput) as caught:
        HeightBand(low, high)
    assert caught.value.code == "priors.height"


@pytest.mark.parametrize("vector", [[0.0, 0.0, 0.0], [1e-9, 0.0, 0.0], [1.0, 2.0], [[1.0, 0, 0]]])
def test_a_direction_has_three_numbers_and_a_length(vector: Any) -> None:
    with pytest.raises(InvalidInput) as caught:
        GravityPrior(np.array(vector), 0.02)
    assert caught.value.field == "priors.gravity.direction"


def test_a_direction_of_any_length_is_taken_at_length_one() -> None:
    for length in (1e-3, 9.81, 1e200):
        prior = GravityPrior(np.array([0.0, 0.0, -length]), 0.02)
        assert prior.direction == pytest.approx([0.0, 0.0, -1.0])


@pytest.mark.parametrize("std", [0.0, -0.1, 0.5, np.nan])
def test_gravity_is_known_to_some_degrees(std: float) -> None:
    with pytest.raises(InvalidInput) as caught:
        GravityPrior(np.array([0.0, 0.0, 1.0]), std)
    assert caught.value.field == "priors.gravity.std_deg"


@pytest.mark.parametrize(
    "covariance",
    [
        np.zeros((6, 6)),
        np.ones((6, 6)),
        np.diag([1.0, 1, 1, 1, 1, 0]),
        np.diag([1.0, 1, 1, 1, 1, -1]),
        np.eye(6) + np.diag([0.5], 5),
        1e-9 * (np.eye(6) + np.diag([0.5], 5)),
        np.eye(6) + 2 * np.diag([1.0], 5) + 2 * np.diag([1.0], -5),
        np.eye(5),
        np.full((6, 6), np.nan),
    ],
)
def test_what_is_no_covariance_is_refused(covariance: NDArray[np.float64]) -> None:
    with pytest.raises(InvalidInput) as caught:
        check_covariance(covariance, "somewhere")
    assert (caught.value.code, caught.value.field) == ("pose.covariance", "somewhere")


@pytest.mark.parametrize("distance", [1e3, 1e6, 7e6])
def test_the_covariance_of_a_pose_far_from_the_origin_is_one(distance: float) -> None:
    # Of a centre known to 5 mm and a rotation known to 1 mrad: t moves with the rotation.
    lever = np.eye(6)
    lever[3:, :3] = distance * np.array([[0.0, -0.6, 0.64], [0.6, 0.0, -0.48], [-0.64, 0.48, 0.0]])
    covariance = lever @ np.diag([1e-6] * 3 + [2.5e-5] * 3) @ lever.T
    check_covariance(covariance, "somewhere")


# A building of two floors that look alike

FLOOR = 3.0
NUM_PHOTOS = 8


class Building:
    """Two floors with the same landmarks, one above the other, 8 photos of each.

    Args:
        localizer: of a real map, of which all but the contents is kept.
        difference: the share of landmarks that only one floor has.
        looks: how much the global descriptors of both floors differ, 0 to 1.
    """

    def __init__(self, localizer: Localizer, difference: float, looks: float) -> None:
        rng = np.random.default_rng(5)
        opened = localizer.map
        num = 300
        points = rng.uniform([-6, -6, 0.3], [6, 6, 2.7], (num, 3))
        dim = opened.manifest.local_features.descriptor_dim
        scale = opened.manifest.local_features.descriptor_scale
        own = int(difference * num)
        descriptors = np.stack([self._units(rng, num, dim)] * 2)
        descriptors[1, :own] = self._units(rng, own, dim)
        self.descriptors = np.rint(descriptors / scale).astype(np.int8)
        self.landmarks = np.stack([points, points + np.array([0.0, 0.0, FLOOR])])
        globals_of = np.stack([self._units(rng, NUM_PHOTOS, 64)] * 2)
        globals_of[1] += looks * self._units(rng, NUM_PHOTOS, 64)
        globals_of /= np.linalg.norm(globals_of, axis=2, keepdims=True)
        self.globals = globals_of.astype(np.float32)
        manifest = opened.manifest
        local = manifest.local_features
        of_floor = [self.pose(floor, photo) for floor in (0, 1) for photo in range(NUM_PHOTOS)]
        seen = np.concatenate(
            [np.arange(num) + floor * num for floor in (0, 1) for _ in range(NUM_PHOTOS)]
        )
        record = manifest.global_features[0]
        kept = {
            "local_features": local.model_copy(
                update={"fingerprint": local.fingerprint.model_copy(update={"name": "kapture:A"})}
            ),
            "global_features": (
                record.model_copy(
                    update={
                        "dim": 64,
                        "fingerprint": record.fingerprint.model_copy(update={"name": "kapture:B"}),
                    }
                ),
            ),
            "world": manifest.world.model_copy(
                update={"gravity": (0.0, 0.0, -1.0), "origin": (0.0, 0.0, 0.0)}
            ),
        }
        self.localizer = Localizer(
            replace(
                opened,
                manifest=manifest.model_copy(update=kept),
                images=tuple(opened.images[i % len(opened.images)] for i in range(2 * NUM_PHOTOS)),
                image_poses=np.array([[*p.rotation_wxyz, *p.translation] for p in of_floor]),
                landmarks=self.landmarks.reshape(-1, 3).astype(np.float32),
                observation_offsets=np.arange(2 * NUM_PHOTOS + 1) * num,
                observation_landmarks=seen.astype(np.uint32),
                observation_descriptors=self.descriptors.reshape(-1, dim)[seen],
                global_descriptors={"kapture:B": GlobalRows(self.globals.reshape(-1, 64))},
                global_models={"kapture:B": {}},
            ),
            None,
        )

    @staticmethod
    def _units(rng: np.random.Generator, count: int, dim: int) -> NDArray[np.float64]:
        vectors = rng.normal(size=(count, dim))
        return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))

    @staticmethod
    def pose(floor: int, photo: float) -> Pose:
        """Around the middle of a floor, level, 1.6 above the ground."""
        around = Rotation.from_euler("z", -360.0 * photo / NUM_PHOTOS, degrees=True).as_matrix()
        level = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
        rotation = level @ around
        center = around.T @ [0.0, -1.0, 0.0] + [0.0, 0.0, FLOOR * floor + 1.6]
        return Pose(rotation, -rotation @ center)

    def ask(self, place: Any, floor: int, priors: Priors, top_k: int = 4) -> Answer:
        """Localize a photo of a floor, a little beside one of the map's."""
        options = LocalizeOptions(top_k=top_k, min_inliers=15)
        features = self.features(place, floor)
        return self.localizer.localize_features(features, place.camera, options, priors)

    def features(
        self, place: Any, floor: int, photo: float = 2.2, *, signs: bool = True
    ) -> QueryFeatures:
        """What that photo shows, or one taken elsewhere around the middle.

        Without ``signs``, it shows nothing that only one of the floors has.
        """
        rng = np.random.default_rng(7)
        pose = self.pose(floor, photo)
        pixels = project(place.camera, pose.apply(self.landmarks[floor]))
        shared = (self.descriptors[0] == self.descriptors[1]).all(axis=1)
        seen = np.flatnonzero(
            np.isfinite(pixels).all(axis=1)
            & (pixels > 0).all(axis=1)
            & (pixels < [640, 480]).all(1)
            & (shared | signs)
        )
        like = self.globals[floor, int(photo)] + 0.2 * self._units(rng, 1, 64)[0]
        return QueryFeatures(
            "kapture:A",
            pixels[seen] + rng.normal(size=(len(seen), 2)) * 0.4,
            self.descriptors[floor, seen].astype(np.float32),
            {"kapture:B": like},
        )

    def band(self, floor: int) -> HeightBand:
        return HeightBand(FLOOR * floor, FLOOR * floor + FLOOR)


@pytest.fixture(scope="module")
def room(built_maps: Any) -> Localizer:
    from visloc.features import make_local_features

    return Localizer(MapStore(built_maps).open("room"), make_local_features("sift"))


@pytest.fixture(scope="module")
def identical(room: Localizer) -> Building:
    return Building(room, 0.0, 0.0)


@pytest.fixture(scope="module")
def different(room: Localizer) -> Building:
    return Building(room, 0.5, 0.5)


def assert_on(answer: Answer, floor: int) -> None:
    assert isinstance(answer, Localized), answer
    distance, angle = pose_error(answer.cam_from_world, Building.pose(floor, 2.2))
    assert distance < 0.05
    assert angle < 0.5


def assert_contradicts(answer: Answer) -> None:
    assert isinstance(answer, NotLocalized), answer
    assert answer.reason is Reason.CONTRADICTS_PRIOR


@pytest.mark.parametrize("floor", [0, 1])
def test_of_identical_floors_the_band_decides(identical: Building, place: Any, floor: int) -> None:
    assert_on(identical.ask(place, floor, Priors(height=identical.band(floor))), floor)


def test_of_identical_floors_a_lie_is_believed_as_nothing_speaks_against_it(
    identical: Building, place: Any
) -> None:
    # Stated in docs/decisions/0010: the photo has no say in where the same was built twice.
    assert_on(identical.ask(place, 0, Priors(height=identical.band(1))), 1)


@pytest.mark.parametrize("floor", [0, 1])
def test_of_floors_that_differ_the_photo_needs_no_prior_and_obeys_a_right_one(
    different: Building, place: Any, floor: int
) -> None:
    assert_on(different.ask(place, floor, NO_PRIORS), floor)
    assert_on(different.ask(place, floor, Priors(height=different.band(floor))), floor)
    center = Building.pose(floor, 2.2).center
    assert_on(different.ask(place, floor, Priors(PositionPrior(center, 1.0))), floor)


@pytest.mark.parametrize("floor", [0, 1])
def test_of_floors_that_differ_a_lie_is_refused(
    different: Building, place: Any, floor: int
) -> None:
    lies = different.band(1 - floor)
    assert_contradicts(different.ask(place, floor, Priors(height=lies)))
    other = Building.pose(1 - floor, 2.2).center
    answer = different.ask(place, floor, Priors(PositionPrior(other, 1.0)))
    assert_contradicts(answer)


@pytest.mark.parametrize("floor", [0, 1])
def test_a_lie_is_refused_where_photos_of_both_floors_look_the_same_at_first(
    room: Localizer, place: Any, floor: int
) -> None:
    # Which photo looks most like the query is chance; half of the landmarks tell.
    building = Building(room, 0.5, 0.0)
    assert_on(building.ask(place, floor, Priors(height=building.band(floor))), floor)
    assert_contradicts(building.ask(place, floor, Priors(height=building.band(1 - floor))))


def test_a_pose_prior_decides_between_identical_floors(identical: Building, place: Any) -> None:
    for floor in (0, 1):
        before = Building.pose(floor, 2.0)
        known = covariance_from_center(before, np.diag([0.1**2] * 3 + [0.4**2] * 3))
        prior = PosePrior(before, known)
        assert_on(identical.ask(place, floor, Priors(pose=prior)), floor)


def test_an_area_without_photos_is_an_answer(identical: Building, place: Any) -> None:
    for priors in (
        Priors(PositionPrior(np.array([0.0, 0.0, 1e6]), 5.0)),
        Priors(height=HeightBand(60.0, 63.0)),
        Priors(pose=PosePrior(Pose(np.eye(3), np.full(3, 1e5)), np.eye(6) * 1e-4)),
        Priors(PositionPrior(np.zeros(3), 1.0), HeightBand(30.0, 33.0)),
    ):
        answer = identical.ask(place, 0, priors)
        assert isinstance(answer, NotLocalized)
        assert (answer.stage, answer.reason) == ("retrieval", Reason.NO_PHOTO_NEAR)
        assert answer.evidence.retrieved == ()
        assert answer.evidence.num_keypoints > 0


def test_only_photos_within_the_area_are_said_to_be_retrieved(
    identical: Building, place: Any
) -> None:
    everywhere = identical.ask(place, 0, NO_PRIORS)
    assert len(everywhere.evidence.retrieved) == 4
    near = identical.ask(place, 0, Priors(height=identical.band(0)))
    similarities = {r.similarities["kapture:B"] for r in near.evidence.retrieved}
    assert len(near.evidence.retrieved) == 4
    assert max(similarities) == pytest.approx(
        max(r.similarities["kapture:B"] for r in everywhere.evidence.retrieved)
    )


@pytest.mark.parametrize(
    ("field", "latitude", "longitude", "accuracies"),
    [
        ("latitude", np.nan, 8.0, (5.0,)),
        ("latitude", 90.1, 8.0, (5.0,)),
        ("longitude", 48.0, -180.1, (5.0,)),
        ("accuracy", 48.0, 8.0, (0.0,)),
        ("accuracy", 48.0, 8.0, (np.nan,)),
        ("accuracy", 48.0, 8.0, (np.inf,)),
        ("altitude", 48.0, 8.0, (5.0, np.inf, 5.0)),
        ("vertical_accuracy", 48.0, 8.0, (5.0, 400.0)),
        ("vertical_accuracy", 48.0, 8.0, (5.0, None, 5.0)),
        ("vertical_accuracy", 48.0, 8.0, (5.0, 400.0, -1.0)),
    ],
)
def test_a_fix_that_no_receiver_gives_is_refused_for_what_is_wrong_with_it(
    field: str, latitude: float, longitude: float, accuracies: Any
) -> None:
    with pytest.raises(InvalidInput) as caught:
        GnssPrior(latitude, longitude, *accuracies)
    assert caught.value.field == f"priors.gnss.{field}"
    assert "Earth" not in caught.value.message
