from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mapping.own_test.trials import Trial, learned, own_test, run_own_test
from visloc.archive import Map
from visloc.archive.schema import Score
from visloc.geometry import Pose

MakeMap = Callable[..., Map]


@pytest.fixture(scope="module")
def square(make_map: MakeMap, room: Callable[..., np.ndarray], looking: Callable[..., Pose]) -> Map:
    """A room of exact landmarks, photographed from its middle."""
    points = room(np.random.default_rng(1), 3000)
    poses = [looking([0.5 * math.sin(i), 0.4 * math.cos(2 * i), 0.0], 15.0 * i) for i in range(24)]
    return make_map(points, poses)


def off_by(opened: Map, position: float, angle: float) -> Map:
    """The same map, with photos that stood elsewhere than it says."""
    random = np.random.default_rng(0)
    rows = []
    for row in opened.image_poses:
        pose = Pose.from_quaternion(row[:4], row[4:])
        turn = Rotation.from_rotvec(angle * random.normal(size=3)).as_matrix()
        center = pose.center + position * random.normal(size=3)
        moved = Pose(turn @ pose.rotation, -turn @ pose.rotation @ center)
        rows.append([*moved.rotation_wxyz, *moved.translation])
    return replace(opened, image_poses=np.array(rows))


def test_a_map_without_errors_is_hardly_worse_than_its_photos_tell(square: Map) -> None:
    test = own_test(square)
    assert (test.tested, test.localized, test.wrong, test.wrong_at) == (12, 12, 0, ())
    assert test.position_factor < 3.0
    assert test.orientation_factor < 3.0
    assert test.independent


def test_the_same_map_has_the_same_test_which_tells_each_photo(square: Map) -> None:
    told: list[tuple[int, int]] = []
    run = run_own_test(square, lambda *now: told.append(now))
    assert run.test == own_test(square)
    assert told == [(done, 12) for done in range(13)]


def test_errors_that_the_residuals_cannot_show_are_found_in_their_size(square: Map) -> None:
    """Poses that are off by centimetres leave every photo's residuals as they were."""
    exact = own_test(square)
    some, more = own_test(off_by(square, 0.02, 0.004)), own_test(off_by(square, 0.04, 0.008))
    assert some.position_factor > 3.0 * exact.position_factor
    assert some.orientation_factor > 3.0 * exact.orientation_factor
    assert more.position_factor == pytest.approx(2.0 * some.position_factor, rel=0.2)
    assert more.orientation_factor == pytest.approx(2.0 * some.orientation_factor, rel=0.2)


def test_position_and_orientation_are_told_apart(square: Map) -> None:
    turned = own_test(off_by(square, 0.0, 0.01))
    assert turned.orientation_factor > 3.0 * turned.position_factor


def test_photos_at_another_place_are_counted_and_left_out_of_the_factors() -> None:
    covariance = np.diag([1e-6] * 3 + [1e-4] * 3)
    random = np.random.default_rng(0)
    right = [
        Trial(random.multivariate_normal(np.zeros(6), covariance), covariance, score(500))
        for _ in range(30)
    ]
    away = [
        Trial(np.array([0.0, 0.0, 0.0, 3.0, 0.0, 0.0]), covariance, score(40)),
        Trial(np.array([0.0, 0.2, 0.0, 0.0, 0.0, 0.0]), covariance, score(80)),
    ]
    test = learned([*right, *away], 40, 10.0, independent=True)
    assert (test.tested, test.localized, test.wrong) == (40, 32, 2)
    assert [one.inliers for one in test.wrong_at] == [80, 40]
    alone = learned(right, 40, 10.0, independent=True)
    assert test.position_factor == alone.position_factor
    assert test.orientation_factor == alone.orientation_factor


def test_a_map_of_one_photo_says_that_it_tested_none(
    make_map: MakeMap, room: Callable[..., np.ndarray], looking: Callable[..., Pose]
) -> None:
    test = own_test(make_map(room(np.random.default_rng(1), 500), [looking([0, 0, 0], 0.0)]))
    assert (test.tested, test.localized) == (0, 0)
    assert test.position_factor > 2.0


def test_poses_that_were_estimated_with_the_landmarks_are_not_independent(square: Map) -> None:
    method = square.manifest.method.model_copy(update={"settings": {"poses": "estimate"}})
    manifest = square.manifest.model_copy(update={"method": method})
    exact, estimated = own_test(square), own_test(replace(square, manifest=manifest))
    assert (exact.independent, estimated.independent) == (True, False)
    assert estimated.position_factor == pytest.approx(1.5 * exact.position_factor, abs=0.01)
    assert estimated.orientation_factor == pytest.approx(1.5 * exact.orientation_factor, abs=0.01)


def test_poses_in_a_unit_that_nobody_knows_are_not_independent_even_in_metres_later(
    square: Map,
) -> None:
    world = square.manifest.world.model_copy(update={"metric": False})
    manifest = square.manifest.model_copy(update={"world": world})
    exact, unscaled = own_test(square), own_test(replace(square, manifest=manifest))
    assert (exact.independent, unscaled.independent) == (True, False)
    assert unscaled.position_factor == pytest.approx(1.5 * exact.position_factor, abs=0.01)

    parts = square.manifest.parts.model_copy(update={"own_test": unscaled})
    tied = square.manifest.model_copy(update={"parts": parts})
    assert own_test(replace(square, manifest=tied)) == unscaled


def score(inliers: int) -> Score:
    return Score(inliers=inliers, inlier_ratio=0.5)
