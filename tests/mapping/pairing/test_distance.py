from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from mapping.pairing import Pairs, PairSettings, Scene
from mapping.pairing.distance import pair_by_distance
from visloc.errors import InvalidInput
from visloc.geometry import Pose, rotation_angle

Make = Callable[..., Scene]
Looking = Callable[..., Pose]
RandomPoses = Callable[..., list[Pose]]


def by_brute_force(scene: Scene, settings: PairSettings) -> dict[tuple[int, int], float]:
    """Score all pairs one by one, with another formula of the angle; keep the best of each."""
    count = len(scene.names)
    scores: dict[tuple[int, int], float] = {}
    for i in range(count):
        for j in range(i + 1, count):
            a, b = scene.cam_from_world[i], scene.cam_from_world[j]
            if a is None or b is None:
                continue
            distance = math.dist(a.center, b.center)
            angle = math.degrees(rotation_angle(a.rotation @ b.rotation.T))
            if distance <= settings.max_distance and angle <= settings.max_angle_deg:
                share = distance / settings.max_distance + angle / settings.max_angle_deg
                scores[i, j] = 2 - share
    return best_of_both(scores, count, settings.top_k)


def best_of_both(
    scores: dict[tuple[int, int], float], count: int, top_k: int
) -> dict[tuple[int, int], float]:
    kept: dict[tuple[int, int], float] = {}
    for photo in range(count):
        own = [pair for pair in scores if photo in pair]
        # Rounding of equal scores differs between formulas.
        own.sort(key=lambda pair: (-round(scores[pair], 9), pair[0] + pair[1] - photo))
        kept |= {pair: scores[pair] for pair in own[:top_k]}
    return kept


def assert_same(pairs: Pairs, expected: dict[tuple[int, int], float]) -> None:
    assert [tuple(row) for row in pairs.rows.tolist()] == sorted(expected)
    np.testing.assert_allclose(pairs.scores, [expected[p] for p in sorted(expected)], atol=1e-7)


def test_score_falls_with_distance_and_angle(make_scene: Make, looking: Looking) -> None:
    scene = make_scene([looking([0, 0, 0]), looking([3, 0, 4], yaw_deg=9.0)])

    pairs = pair_by_distance(scene, PairSettings())

    assert pairs.rows.tolist() == [[0, 1]]
    assert pairs.scores[0] == pytest.approx(2 - 5 / 25 - 9 / 45, abs=1e-12)


@pytest.mark.parametrize(
    ("center", "yaw", "paired"),
    [
        ([24.9, 0, 0], 0.0, True),
        ([25.1, 0, 0], 0.0, False),
        ([0, 0, 0], 44.9, True),
        ([0, 0, 0], 45.1, False),
        ([24.9, 0, 0], 44.9, True),
    ],
)
def test_pairs_beyond_either_limit_are_rejected(
    make_scene: Make, looking: Looking, center: list[float], yaw: float, paired: bool
) -> None:
    scene = make_scene([looking([0, 0, 0]), looking(center, yaw)])

    assert len(pair_by_distance(scene, PairSettings())) == paired


def test_centimetres_count_at_utm_coordinates(make_scene: Make, looking: Looking) -> None:
    utm = np.array([448_000.0, 5_411_000.0, 300.0])
    scene = make_scene([looking(utm + np.array([x, 0, 0])) for x in (0.0, 0.03, 0.05, 0.11)])

    pairs = pair_by_distance(scene, PairSettings(top_k=1))

    assert pairs.rows.tolist() == [[0, 1], [1, 2], [2, 3]]
    np.testing.assert_allclose((2 - pairs.scores) * 25, [0.03, 0.02, 0.06], atol=1e-6)


def test_every_photo_keeps_its_own_best(make_scene: Make, looking: Looking) -> None:
    # The last photo is nobody's nearest, and comes after all others.
    scene = make_scene([looking([x, 0, 0]) for x in (0.0, 0.1, 0.3, 0.7, 5.0)])

    pairs = pair_by_distance(scene, PairSettings(top_k=1))

    assert [3, 4] in pairs.rows.tolist()


def test_photos_without_a_pose_get_no_pair(make_scene: Make, looking: Looking) -> None:
    scene = make_scene([None, looking([0, 0, 0]), None, looking([1, 0, 0])])

    assert pair_by_distance(scene, PairSettings()).rows.tolist() == [[1, 3]]


@pytest.mark.parametrize("max_angle_deg", [30.0, 180.0])
@pytest.mark.parametrize("extent", [(6.0, 2.0, 5.0), (300.0, 3.0, 200.0)])
def test_pairs_equal_those_of_all_pairs_compared(
    make_scene: Make, random_poses: RandomPoses, extent: tuple[float, ...], max_angle_deg: float
) -> None:
    scene = make_scene([*random_poses(150, 0, extent), None])
    settings = PairSettings(top_k=3, max_angle_deg=max_angle_deg)

    assert_same(pair_by_distance(scene, settings), by_brute_force(scene, settings))


def test_dense_pairs_equal_those_of_all_pairs_compared(
    make_scene: Make, random_poses: RandomPoses
) -> None:
    # All within max_distance of one another, and most rejected by the angle.
    scene = make_scene(random_poses(2000, 1, (8.0, 2.5, 6.0)))
    settings = PairSettings(top_k=5)
    centers = np.stack([pose.center for pose in scene.cam_from_world if pose])
    rotations = np.stack([pose.rotation for pose in scene.cam_from_world if pose])

    pairs = pair_by_distance(scene, settings)

    expected = set()
    for i in range(0, 2000):
        cosine = (np.einsum("pij,ij->p", rotations, rotations[i]) - 1) / 2
        angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        distance = np.linalg.norm(centers - centers[i], axis=1)
        score = 2 - distance / 25 - angle / 45
        score[(distance > 25) | (angle > 45)] = -np.inf
        score[i] = -np.inf
        best = np.argsort(-score)[:5]
        expected |= {(min(i, j), max(i, j)) for j in best[score[best] > -np.inf].tolist()}
    assert {(i, j) for i, j in pairs.rows.tolist()} == expected


def test_a_camera_that_stood_still_is_paired_by_row(make_scene: Make, looking: Looking) -> None:
    scene = make_scene([looking([1, 2, 3])] * 60)

    pairs = pair_by_distance(scene, PairSettings(top_k=2))

    # All scores are equal; the best two of each are the first two rows.
    expected = [[0, 1], *([0, j] for j in range(2, 60)), *([1, j] for j in range(2, 60))]
    assert pairs.rows.tolist() == sorted(expected)
    assert (pairs.scores == 2.0).all()


def test_poses_are_needed(make_scene: Make, looking: Looking) -> None:
    with pytest.raises(InvalidInput) as caught:
        pair_by_distance(make_scene([None, looking([0, 0, 0]), None]), PairSettings())

    assert (caught.value.code, caught.value.field) == ("pairs.no_poses", "--pairs")
