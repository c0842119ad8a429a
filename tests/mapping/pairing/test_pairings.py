"""The pairings without geometry, and several at once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.pairing import PAIRINGS, Pairs, PairSettings, Scene, pair_photos
from mapping.pairing.exhaustive import MAX_PHOTOS
from visloc.errors import InvalidInput, TooLarge
from visloc.geometry import Pose
from visloc.retrieval.fusion import equal_weights, gharm

Make = Callable[..., Scene]
Looking = Callable[..., Pose]
ABC = ["a.jpg", "b.jpg", "c.jpg", "d.jpg"]


def as_dict(pairs: Pairs) -> dict[tuple[int, int], float]:
    return {(i, j): s for (i, j), s in zip(pairs.rows.tolist(), pairs.scores, strict=True)}


def on_circle(*degrees: float) -> NDArray[np.float32]:
    angles = np.radians(degrees)
    return np.column_stack([np.cos(angles), np.sin(angles)]).astype(np.float32)


def random_units(count: int, dim: int, seed: int) -> NDArray[np.float32]:
    rows = np.random.default_rng(seed).normal(size=(count, dim))
    return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True), dtype=np.float32)


# --- retrieval


def test_photos_that_look_alike_are_paired(make_scene: Make) -> None:
    scene = make_scene(names=ABC, global_descriptors={"g": on_circle(0, 60, 10, 75)})

    pairs = as_dict(PAIRINGS["retrieval"](scene, PairSettings(top_k=1)))

    assert list(pairs) == [(0, 2), (1, 3)]
    assert pairs[0, 2] == pytest.approx(np.cos(np.radians(10)), abs=1e-6)


def test_a_photo_that_is_nobodys_best_still_has_its_pairs(make_scene: Make) -> None:
    scene = make_scene(names=ABC, global_descriptors={"g": on_circle(0, 1, 2, 90)})

    pairs = as_dict(PAIRINGS["retrieval"](scene, PairSettings(top_k=1)))

    assert (2, 3) in pairs


def test_several_descriptors_are_fused_as_in_localization(make_scene: Make) -> None:
    tables = {"g": random_units(300, 16, 0), "h": random_units(300, 8, 1)}

    pairs = as_dict(
        PAIRINGS["retrieval"](
            make_scene(names=[f"{i}" for i in range(300)], global_descriptors=tables),
            PairSettings(top_k=3),
        )
    )

    expected = set()
    for i in range(300):
        cosines = np.stack([(t.astype(np.float64) @ t[i]) for t in tables.values()])
        scores = gharm(np.clip(cosines, -1, 1), equal_weights(2), 0.5)
        scores[i] = -np.inf
        for j in np.argsort(-scores, kind="stable")[:3].tolist():
            expected.add((min(i, j), max(i, j)))
            assert pairs[min(i, j), max(i, j)] == pytest.approx(scores[j], abs=1e-5)
    assert set(pairs) == expected


def test_equal_scores_are_ranked_by_row(make_scene: Make) -> None:
    scene = make_scene(names=ABC, global_descriptors={"g": np.zeros((4, 2), dtype=np.float32)})

    pairs = PAIRINGS["retrieval"](scene, PairSettings(top_k=1))

    assert pairs.rows.tolist() == [[0, 1], [0, 2], [0, 3]]


def test_a_global_descriptor_with_nan_names_the_photo(make_scene: Make) -> None:
    rows = on_circle(0, 1, 2, 3)
    rows[2, 1] = np.nan
    with pytest.raises(InvalidInput) as caught:
        PAIRINGS["retrieval"](make_scene(names=ABC, global_descriptors={"g": rows}), PairSettings())

    assert (caught.value.code, caught.value.field) == ("pairs.global_descriptor", "c.jpg")


# --- covisibility


def test_photos_that_share_points_are_paired_by_their_number(make_scene: Make) -> None:
    # Points 7 and 8 are seen by a, b, c; 9 by a, b twice; d sees a point alone.
    tracks = [(7, 0), (7, 1), (7, 2), (8, 0), (8, 1), (8, 2), (9, 0), (9, 1), (9, 1), (5, 3)]
    scene = make_scene(names=ABC, tracks=tracks)

    pairs = as_dict(PAIRINGS["covisibility"](scene, PairSettings()))

    assert pairs == {(0, 1): 3, (0, 2): 2, (1, 2): 2}


def test_tracks_of_two_photos_count(make_scene: Make) -> None:
    scene = make_scene(names=ABC, tracks=[(0, 2), (0, 1)])

    assert as_dict(PAIRINGS["covisibility"](scene, PairSettings())) == {(1, 2): 1}


def test_late_photos_keep_their_own_most_covisible(make_scene: Make) -> None:
    # a shares 3 points with b, 2 with c, 1 with d: d is the best of none but has a best of its own.
    shared = [(0, 1)] * 3 + [(0, 2)] * 2 + [(0, 3)]
    tracks = [(point, photo) for point, pair in enumerate(shared) for photo in pair]
    scene = make_scene(names=ABC, tracks=tracks)

    pairs = as_dict(PAIRINGS["covisibility"](scene, PairSettings(top_k=1)))

    assert pairs == {(0, 1): 3, (0, 2): 2, (0, 3): 1}


def test_covisibility_in_blocks_equals_counting(make_scene: Make) -> None:
    rng = np.random.default_rng(0)
    tracks = np.column_stack([rng.integers(-9, 400, 4000), rng.integers(0, 1100, 4000)])
    scene = make_scene(names=[f"{i}" for i in range(1100)], tracks=tracks)

    pairs = PAIRINGS["covisibility"](scene, PairSettings(top_k=2000))

    sees = np.zeros((1100, 409), dtype=np.int64)
    sees[tracks[:, 1], tracks[:, 0] + 9] = 1
    shared = np.triu(sees @ sees.T, k=1)
    assert pairs.rows.tolist() == np.argwhere(shared).tolist()
    assert pairs.scores.tolist() == shared[shared > 0].tolist()


# --- sequence


def test_neighbours_in_time_of_one_camera_are_paired(make_scene: Make) -> None:
    names = ["l3", "l1", "r1", "l2", "r2", "alone"]
    sensors = ["left", "left", "right", "left", "right", "other"]
    scene = make_scene(names=names, sensors=sensors, timestamps=[30, 10, 10, 20, 20, 5])

    pairs = as_dict(PAIRINGS["sequence"](scene, PairSettings(top_k=4)))

    assert pairs == {(1, 3): 0.75, (0, 3): 0.75, (0, 1): 0.5, (2, 4): 0.75}


def test_photos_at_the_ends_have_as_many_pairs_as_others(make_scene: Make) -> None:
    scene = make_scene(names=[f"{i}" for i in range(50)])

    pairs = PAIRINGS["sequence"](scene, PairSettings(top_k=6))

    assert np.bincount(pairs.rows.ravel()).min() == 6
    middle = pairs.rows[(pairs.rows == 25).any(axis=1)].sum(axis=1) - 25
    assert sorted(middle.tolist()) == [22, 23, 24, 26, 27, 28]


# --- exhaustive


def test_exhaustive_pairs_all_whatever_top_k(make_scene: Make) -> None:
    pairs = PAIRINGS["exhaustive"](make_scene(names=ABC), PairSettings(top_k=1))

    assert pairs.rows.tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]
    assert pairs.scores.tolist() == [1.0] * 6


def test_exhaustive_refuses_days_of_matching(make_scene: Make) -> None:
    scene = make_scene(names=[f"{i}" for i in range(MAX_PHOTOS + 1)])
    with pytest.raises(TooLarge) as caught:
        PAIRINGS["exhaustive"](scene, PairSettings())

    assert (caught.value.code, caught.value.field) == ("pairs.too_many_photos", "--pairs")


# --- several


def test_scores_of_one_pairing_are_its_own(make_scene: Make) -> None:
    scene = make_scene(names=ABC)

    pairs = as_dict(pair_photos(scene, ["sequence", "sequence"], PairSettings(top_k=2)))

    assert pairs[0, 1] == 0.5


def test_several_pairings_are_united_and_counted(make_scene: Make) -> None:
    scene = make_scene(names=ABC, tracks=[(0, 0), (0, 3), (1, 0), (1, 1)])

    pairs = as_dict(pair_photos(scene, ["covisibility", "sequence"], PairSettings(top_k=2)))

    assert pairs == {(0, 1): 2, (0, 2): 1, (0, 3): 1, (1, 2): 1, (1, 3): 1, (2, 3): 1}


@pytest.mark.parametrize(
    ("name", "code"),
    [
        ("retrieval", "pairs.no_global_descriptors"),
        ("distance", "pairs.no_poses"),
        ("frustum", "pairs.no_poses"),
        ("covisibility", "pairs.no_tracks"),
        ("sequence", "pairs.no_sequence"),
    ],
)
def test_a_scene_that_lacks_what_a_pairing_needs_is_refused(
    make_scene: Make, name: str, code: str
) -> None:
    with pytest.raises(InvalidInput) as caught:
        pair_photos(make_scene(names=ABC, sensors=ABC), [name], PairSettings())

    assert (caught.value.code, caught.value.field) == (code, "--pairs")
    assert name in str(caught.value)


@pytest.mark.parametrize("names", [[], ["distance", "closeness"]])
def test_unknown_pairings_are_answered_with_the_known_ones(
    make_scene: Make, names: list[str]
) -> None:
    with pytest.raises(InvalidInput) as caught:
        pair_photos(make_scene(names=ABC), names, PairSettings())

    assert caught.value.code == "pairs.unknown"
    assert all(name in str(caught.value.expected) for name in PAIRINGS)


@pytest.mark.parametrize("name", PAIRINGS)
@pytest.mark.parametrize("top_k", [1, 2, 1000])
def test_every_pairing_gives_sorted_unique_pairs(
    make_scene: Make, looking: Looking, name: str, top_k: int
) -> None:
    scene = make_scene(
        [looking([0.3 * i, 0, 0]) for i in range(12)],
        global_descriptors={"g": random_units(12, 4, 0)},
        tracks=[(point, (point + step) % 12) for point in range(30) for step in (0, 1, 3)],
    )

    pairs = pair_photos(scene, [name], PairSettings(top_k=top_k))

    assert pairs.rows.dtype == np.int64
    assert pairs.scores.dtype == np.float64
    assert (pairs.rows[:, 0] < pairs.rows[:, 1]).all()
    assert pairs.rows.tolist() == sorted({(i, j): [i, j] for i, j in pairs.rows.tolist()}.values())
    assert np.bincount(pairs.rows.ravel(), minlength=12).min() >= min(top_k, 2)


# --- settings


@pytest.mark.parametrize(
    ("settings", "code", "option"),
    [
        ({"top_k": 0}, "pairs.top_k", "--top-k"),
        ({"max_distance": 0.0}, "pairs.max_distance", "--max-distance"),
        ({"max_distance": float("nan")}, "pairs.max_distance", "--max-distance"),
        ({"max_distance": float("inf")}, "pairs.max_distance", "--max-distance"),
        ({"max_angle_deg": -1.0}, "pairs.max_angle", "--max-angle"),
        ({"max_angle_deg": 180.5}, "pairs.max_angle", "--max-angle"),
        ({"near": 0.0}, "pairs.near", "--near"),
        ({"near": float("nan")}, "pairs.near", "--near"),
        ({"near": 5.0, "far": 5.0}, "pairs.far", "--far"),
        ({"far": float("inf")}, "pairs.far", "--far"),
    ],
)
def test_settings_out_of_range_name_their_option(
    settings: dict[str, float], code: str, option: str
) -> None:
    with pytest.raises(InvalidInput) as caught:
        PairSettings(**settings)  # type: ignore[arg-type]

    assert (caught.value.code, caught.value.field) == (code, option)
