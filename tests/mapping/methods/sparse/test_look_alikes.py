"""Two hallways of one design: what both show matches in every pair of photos."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from mapping.methods.matching.stages import Matches
from mapping.methods.sparse.look_alikes import without_look_alikes
from mapping.methods.sparse.model import MAPPER_CONFIGS, SfmPhoto
from mapping.methods.sparse.triangulation import reconstruct
from visloc.geometry import Camera, Pose
from visloc.pose.reprojection import project

CAMERA = Camera("SIMPLE_PINHOLE", 640, 480, (450.0, 320.0, 240.0))
NUM_POINTS, PHOTOS_EACH = 500, 8


def make_hallways(share_of_design: float, *, rows: bool = True) -> list[SfmPhoto]:
    """Return photos of two places, from equal poses: keypoint k shows point k of either.

    Args:
        rows: one hallway after the other in time; else in turn.
    """
    random = np.random.default_rng(0)
    points = [random.uniform([-3, -2, 3], [3, 2, 9], (NUM_POINTS, 3)) for _ in range(2)]
    num_alike = round(share_of_design * NUM_POINTS)
    points[1][:num_alike] = points[0][:num_alike]
    photos = []
    for place in range(2):
        for number in range(PHOTOS_EACH):
            pose = Pose(np.eye(3), np.array([-0.25 * number, 0.05 * (number % 3), -0.1 * number]))
            pixels = project(CAMERA, pose.apply(points[place]))
            time = PHOTOS_EACH * place + number if rows else 2 * number + place
            photos.append(
                SfmPhoto(
                    f"{place}-{number}.jpg",
                    "cam",
                    time,
                    CAMERA,
                    True,
                    None,
                    pixels.astype(np.float32),
                )
            )
    return photos


def matches_of(photos: list[SfmPhoto], share_of_design: float) -> list[Matches]:
    """All that is in both photos of a pair, and of two hallways only the design."""
    found = []
    for a, b in combinations(range(len(photos)), 2):
        shown = np.ones(NUM_POINTS, dtype=bool)
        for photo in (photos[a], photos[b]):
            shown &= ((photo.keypoints > 0) & (photo.keypoints < (640, 480))).all(axis=1)
        if place_of(a) != place_of(b):
            shown[round(share_of_design * NUM_POINTS) :] = False
        rows = np.flatnonzero(shown).astype(np.uint32)
        found.append(Matches(a, b, np.column_stack([rows, rows])))
    return found


def place_of(row: int) -> int:
    return row // PHOTOS_EACH


@pytest.mark.parametrize("rows", [True, False])
def test_pairs_of_two_places_are_dropped_and_pairs_of_one_stay(rows: bool) -> None:
    share = 0.08
    photos = make_hallways(share, rows=rows)
    matches = matches_of(photos, share)
    across = [pair for pair in matches if place_of(pair.first) != place_of(pair.second)]
    # Without the test they would be joined: many more than a mapper asks for.
    assert min(len(pair.rows) for pair in across) >= MAPPER_CONFIGS["config1"].min_num_matches
    within = [pair for pair in matches if place_of(pair.first) == place_of(pair.second)]
    assert without_look_alikes(photos, matches) == within


def test_the_next_photo_in_time_needs_less_than_a_later_one() -> None:
    photos = make_hallways(0)[:PHOTOS_EACH]
    pairs = {(p.first, p.second): p for p in matches_of(photos, 0) if p.second < PHOTOS_EACH}
    # Two halves of the walk, and one pair between them.
    halves = [p for rows, p in pairs.items() if (rows[0] < 4) == (rows[1] < 4)]
    near, far = few_of(pairs[3, 4]), few_of(pairs[0, 7])
    assert near in without_look_alikes(photos, [*halves, near])
    assert far not in without_look_alikes(photos, [*halves, far])


def few_of(pair: Matches, shift: int = 0) -> Matches:
    """A fifth of a pair's matches, each keypoint with the one that comes ``shift`` later."""
    some = pair.rows[::5]
    rows = np.column_stack([some[:, 0], np.roll(some[:, 1], shift)])
    return Matches(pair.first, pair.second, rows)


def test_a_pair_is_believed_when_third_photos_link_the_same_keypoints() -> None:
    photos = make_hallways(0)[:PHOTOS_EACH]
    pairs = {(p.first, p.second): p for p in matches_of(photos, 0) if p.second < PHOTOS_EACH}
    farthest = pairs.pop((0, 7))
    same, another = few_of(farthest), few_of(farthest, shift=1)
    assert same in without_look_alikes(photos, [*pairs.values(), same])
    assert another not in without_look_alikes(photos, [*pairs.values(), another])


@pytest.mark.parametrize("rows", [(2, 13), (5, 10)])
def test_a_pair_that_lacks_nothing_is_not_believed_when_those_beside_it_fail(
    rows: tuple[int, int],
) -> None:
    photos = make_hallways(1.0)
    full, few = (
        {(pair.first, pair.second): pair for pair in matches_of(photos, share)}
        for share in (1.0, 0.08)
    )
    within = [pair for (a, b), pair in full.items() if place_of(a) == place_of(b)]
    assert full[rows] in without_look_alikes(photos, [*within, full[rows]])
    assert full[rows] in without_look_alikes(photos, [*full.values()])
    assert full[rows] not in without_look_alikes(photos, [*(few | {rows: full[rows]}).values()])


def test_two_photos_alone_are_believed() -> None:
    photos = make_hallways(0.2)
    (pair,) = [p for p in matches_of(photos, 0.2) if (p.first, p.second) == (0, 7)]
    assert without_look_alikes(photos, [pair]) == [pair]


def test_no_pairs_are_no_pairs() -> None:
    assert without_look_alikes(make_hallways(0.2), []) == []


def test_no_model_holds_photos_of_two_hallways(tmp_path: Path) -> None:
    share = 0.08
    photos = make_hallways(share)
    matches = matches_of(photos, share)
    model = reconstruct(
        photos, {}, matches, MAPPER_CONFIGS["config1"], (), tmp_path, lambda *_: None
    )
    places = {place_of(row) for row, view in enumerate(model.views) if view is not None}
    assert len(places) == 1
    assert sum(view is not None for view in model.views) == PHOTOS_EACH
