from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.visloc.answers import localized, refused
from visloc.archive import Anchor, Geodetic, SetOutline
from visloc.archive.set_outline import tiles_near
from visloc.errors import InvalidInput, NotFound
from visloc.geodesy import geodetic_from_enu
from visloc.geometry import Pose
from visloc.priors import (
    NO_PRIORS,
    GnssPrior,
    GravityPrior,
    HeightBand,
    PosePrior,
    PositionPrior,
    Priors,
)
from visloc_extensions.sets.choosing import (
    allowed_tiles,
    is_clear,
    is_doubtful,
    nearest_tile,
    plan,
)
from visloc_extensions.sets.coarse import TileScore

MakeOutline = Callable[..., SetOutline]
# Two floors of a house and a house 100 away.
HOUSES = [
    ((0, 0, 1), (10, 10, 2)),
    ((0, 0, 4), (10, 10, 5)),
    ((100, 0, 1), (110, 10, 2)),
]
DOWN = (0.0, 0.0, -1.0)


# Which tiles


def test_tiles_near_are_those_whose_boxes_reach_into_a_circle(outline: MakeOutline) -> None:
    houses = outline(HOUSES)
    assert not tiles_near(houses, 48.0, 8.0, 1e6).any()  # it lies nowhere on Earth
    # A frame of half metres, turned by 90 degrees: its x points north, its y west.
    turn = np.sqrt(0.5)
    geodetic = Geodetic(
        latitude_deg=48.0,
        longitude_deg=8.0,
        altitude_m=400.0,
        rotation_wxyz=(turn, 0.0, 0.0, turn),
        translation=(0.0, 0.0, 0.0),
        scale=0.5,
    )
    world = houses.manifest.world.model_copy(
        update={"anchor": Anchor(kind="correspondences", images=3, rms=None, geodetic=geodetic)}
    )
    anchored = replace(houses, manifest=houses.manifest.model_copy(update={"world": world}))
    # Circles about the boxes have a radius of 2.5 m times the root of 2.
    for east, north, radius, expected in (
        (-2.5, 2.5, 0.1, [True, True, False]),
        (-2.5, 52.5, 0.1, [False, False, True]),
        (-2.5, 27.5, 21.0, [False, False, False]),
        (-2.5, 27.5, 22.0, [True, True, True]),
    ):
        origin = np.array([48.0, 8.0, 400.0])
        ((latitude, longitude, _),) = geodetic_from_enu(np.array([[east, north, 0.0]]), origin)
        found = tiles_near(anchored, latitude, longitude, radius)
        assert found.tolist() == expected
    # A fix 1 m north of the last house, whose photos see 1 m far, by a unit of 0.5 m.
    ((latitude, longitude, _),) = geodetic_from_enu(np.array([[-2.5, 56.0, 0.0]]), origin)
    fix = Priors(gnss=GnssPrior(latitude, longitude, 1.0))
    assert allowed_tiles(anchored, fix).tolist() == [False, False, True]
    assert nearest_tile(anchored, fix) == 2
    with pytest.raises(InvalidInput):
        allowed_tiles(houses, fix)


def test_tiles_that_are_asked_for_are_narrowed_further(outline: MakeOutline) -> None:
    houses = outline(HOUSES, names=("low", "high", "away"))
    there = Priors(position=PositionPrior(np.array([5.0, 5, 1.5]), 1.0))
    within = np.array([False, True, True])
    assert allowed_tiles(houses, there, within).tolist() == [False, True, False]
    with pytest.raises(NotFound):
        allowed_tiles(houses, there, np.array([False, False, True]))
    assert within.tolist() == [False, True, True]


def test_the_nearest_tile_is_one_that_is_asked_for(outline: MakeOutline) -> None:
    houses = outline(HOUSES, names=("low", "high", "away"))
    far = PositionPrior(np.array([300.0, 0, 0]), 1.0)
    assert nearest_tile(houses, Priors(position=far)) == 2
    assert nearest_tile(houses, Priors(position=far, maps=("low", "high"))) in (0, 1)
    assert nearest_tile(houses, Priors(position=far), np.array([False, True, False])) == 1
    assert nearest_tile(houses, Priors(height=HeightBand(50.0, 51.0))) == 0
    with pytest.raises(NotFound):
        nearest_tile(houses, Priors(position=far, maps=("away",)), np.array([True, True, False]))


def test_without_priors_all_tiles_are_allowed(outline: MakeOutline) -> None:
    assert allowed_tiles(outline(HOUSES), NO_PRIORS).tolist() == [True, True, True]


@pytest.mark.parametrize(
    ("x", "radius", "expected"),
    [
        (5, 1, [True, True, False]),
        # Photos see 3, and count up to twice that beyond the sphere: 10 + 6 + 1.
        (16.9, 1, [True, True, False]),
        (93.1, 1, [False, False, True]),
        (50, 50, [True, True, True]),
    ],
)
def test_a_sphere_allows_tiles_whose_photos_may_show_it(
    outline: MakeOutline, x: float, radius: float, expected: list[bool]
) -> None:
    priors = Priors(position=PositionPrior(np.array([x, 5.0, 3.0]), radius))

    assert allowed_tiles(outline(HOUSES), priors).tolist() == expected


def test_a_pose_prior_narrows_as_far_as_it_is_sure(outline: MakeOutline) -> None:
    pose = Pose(np.eye(3), -np.array([105.0, 5.0, 1.5]))
    sure = PosePrior(pose, np.diag([1e-10] * 3 + [0.25] * 3))
    unsure = PosePrior(pose, np.diag([1e-10] * 3 + [40.0**2] * 3))

    assert allowed_tiles(outline(HOUSES), Priors(pose=sure)).tolist() == [False, False, True]
    assert allowed_tiles(outline(HOUSES), Priors(pose=unsure)).all()


def test_a_height_band_takes_one_floor(outline: MakeOutline) -> None:
    made = outline(HOUSES, gravity=DOWN)

    upper = allowed_tiles(made, Priors(height=HeightBand(3.5, 6.0)))
    both = allowed_tiles(made, Priors(height=HeightBand(1.0, 5.0)))

    assert upper.tolist() == [False, True, False]
    assert both.all()


def test_a_height_band_takes_down_from_the_priors_too(outline: MakeOutline) -> None:
    # Down is x: heights are -x.
    priors = Priors(
        height=HeightBand(-12.0, 0.0),
        gravity=GravityPrior(np.array([0, 1.0, 0]), 0.02, np.array([1.0, 0, 0])),
    )

    assert allowed_tiles(outline(HOUSES), priors).tolist() == [True, True, False]
    with pytest.raises(InvalidInput) as caught:
        allowed_tiles(outline(HOUSES), Priors(height=HeightBand(0.0, 3.0)))
    assert caught.value.code == "priors.height"


def test_tiles_are_named_by_id_or_version(outline: MakeOutline) -> None:
    made = outline(HOUSES, names=("floor", "floor", "barn"))

    assert allowed_tiles(made, Priors(maps=("floor",))).tolist() == [True, True, False]
    assert allowed_tiles(made, Priors(maps=("barn@v1",))).tolist() == [False, False, True]
    with pytest.raises(InvalidInput, match="has no such tile") as caught:
        allowed_tiles(made, Priors(maps=("barn", "attic")))
    assert (caught.value.code, caught.value.got) == ("priors.maps", "attic")


def test_priors_that_no_tile_obeys_are_an_error(outline: MakeOutline) -> None:
    priors = Priors(
        position=PositionPrior(np.array([105.0, 5.0, 1.0]), 1.0), maps=("tile-0", "tile-1")
    )

    with pytest.raises(NotFound) as caught:
        allowed_tiles(outline(HOUSES), priors)
    assert caught.value.code == "set.no_tile"


# In which order


def test_tiles_about_as_good_as_the_best_are_searched_with_it() -> None:
    scores = [TileScore(row, score) for row, score in ((4, 0.5), (2, 0.26), (7, 0.24), (1, 0.1))]

    assert plan(scores) == ((4, 2), (7, 1))


def test_five_tiles_are_searched_at_most() -> None:
    assert plan([TileScore(row, 0.5) for row in range(9)]) == ((0, 1, 2, 3, 4), ())
    assert plan([TileScore(row, 0.5 * 0.4**row) for row in range(9)]) == ((0,), (1, 2, 3, 4))


def test_scores_that_say_nothing_leave_one_tile_first() -> None:
    assert plan([TileScore(0, -0.01), TileScore(1, -0.02)]) == ((0,), (1,))


def test_an_answer_is_clear_with_many_inliers() -> None:
    assert is_clear(localized(100))
    assert not is_clear(localized(99))
    assert not is_clear(refused(500))


def test_a_doubtful_answer_is_not_clear() -> None:
    answer = localized(500)
    assert answer.pose is not None
    for probability, clear in ((0.89, False), (0.9, True), (None, True)):
        asked = replace(answer, pose=replace(answer.pose, probability=probability))
        assert is_clear(asked) == clear
        assert is_doubtful(asked) == (not clear)
    assert not is_doubtful(refused(500))
