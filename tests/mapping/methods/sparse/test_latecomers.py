"""Photos that a model left out find their place in it, and those of another hallway none."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapping.methods.matching.stages import Matches
from mapping.methods.sparse.extending import extend
from mapping.methods.sparse.intrinsics import Doubt
from mapping.methods.sparse.latecomers import Late, place_latecomers
from mapping.methods.sparse.model import MAPPER_CONFIGS, SfmPhoto, SparseModel
from mapping.stages.landmarks import Observations, View
from visloc.geometry import Camera, Pose
from visloc.pose.reprojection import project

CAMERA = Camera("SIMPLE_PINHOLE", 640, 480, (450.0, 320.0, 240.0))
CONFIG = MAPPER_CONFIGS["config1"]
# The walk leads along a wall, of which each photo sees a part. The model has the first photos.
NUM_PHOTOS, NUM_PLACED, NUM_POINTS = 12, 8, 2400
Looks = list[NDArray[np.int8]]


def pose_at(number: float) -> Pose:
    return Pose(np.eye(3), np.array([-0.8 * number, 0.05 * (number % 3), -0.05 * number]))


def walk(alike: float = 1.0) -> tuple[list[SfmPhoto], Looks, list[Matches], SparseModel]:
    """The photos of a walk, and a model of the first of them.

    Args:
        alike: share of the wall that photos after the model's show; the rest is another wall.
    """
    random = np.random.default_rng(0)
    points = random.uniform([-4, -2, 3], [13, 2, 6], (NUM_POINTS, 3))
    looks = random.integers(-127, 128, (NUM_POINTS, 32)).astype(np.int8)
    same = random.random(NUM_POINTS) < alike
    photos, descriptors, found = [], [], []
    for row in range(NUM_PHOTOS):
        # On another wall, photos are taken from where those of the model were, and a bit beside.
        at = row if row < NUM_PLACED or alike == 1 else row - NUM_PLACED + 2.5
        pixels = project(CAMERA, pose_at(at).apply(points)) + random.normal(0, 0.3, (NUM_POINTS, 2))
        inside = ((pixels > 0) & (pixels < (640, 480))).all(axis=1)
        found.append(inside & (random.random(NUM_POINTS) < 0.9))
        if row >= NUM_PLACED:
            found[-1] &= same
        photos.append(
            SfmPhoto(f"{row}.jpg", "cam", row, CAMERA, True, None, pixels.astype(np.float32))
        )
        others = random.integers(-127, 128, looks.shape).astype(np.int8)
        descriptors.append(np.where(found[-1][:, None], looks, others))
    matches = [
        Matches(a, b, np.repeat(rows[:, None], 2, axis=1).astype(np.uint32))
        for a, b in combinations(range(NUM_PHOTOS), 2)
        if len(rows := np.flatnonzero(found[a] & found[b])) >= CONFIG.min_num_matches
    ]
    return photos, descriptors, matches, model_of(photos, points, found[:NUM_PLACED])


def model_of(
    photos: list[SfmPhoto], points: NDArray[np.float64], found: list[NDArray[np.bool_]]
) -> SparseModel:
    landmarks = np.sum(found, axis=0) >= 2
    number = np.cumsum(landmarks) - 1
    views, rows = np.nonzero(np.array(found) & landmarks)
    pixels = np.array([photos[v].keypoints[r] for v, r in zip(views, rows, strict=True)])
    placed = tuple(
        View(CAMERA, pose_at(row)) if row < NUM_PLACED else None for row in range(NUM_PHOTOS)
    )
    seen = Observations(number[rows], views, rows, pixels)
    angles = np.full(landmarks.sum(), 10, np.float32)
    return SparseModel(placed, points[landmarks], seen, angles, False, {})


def late_in(
    photos: list[SfmPhoto], looks: Looks, matches: list[Matches], model: SparseModel
) -> Late:
    return place_latecomers(photos, looks.__getitem__, matches, model, CONFIG, lambda *_: None)


def off(view: View | None, at: float) -> float:
    assert view is not None
    return float(np.linalg.norm(view.cam_from_world.center - pose_at(at).center))


def test_photos_find_their_place_one_after_another() -> None:
    photos, looks, matches, model = walk()
    # The last shares next to nothing with the model.
    near = [pair for pair in matches if pair.second - pair.first <= 2]
    late = late_in(photos, looks, near, model)
    assert late.rows == tuple(range(NUM_PLACED, NUM_PHOTOS))
    assert late.views[:NUM_PLACED] == model.views[:NUM_PLACED]
    assert max(off(late.views[row], row) for row in late.rows) < 0.02
    assert {(p.first, p.second) for p in late.matches} == {
        (p.first, p.second) for p in near if p.second >= NUM_PLACED
    }


def test_photos_of_another_wall_of_one_design_find_none() -> None:
    photos, looks, matches, model = walk(alike=0.25)
    across = [p for p in matches if p.first < NUM_PLACED <= p.second]
    # By their matches alone they would.
    assert max(len(pair.rows) for pair in across) >= 2 * CONFIG.abs_pose_min_num_inliers
    assert late_in(photos, looks, matches, model).rows == ()


def test_photos_of_a_camera_in_doubt_find_none() -> None:
    photos, looks, matches, model = walk()
    doubted = replace(model, doubts={"cam": Doubt("undetermined", 450.0)})
    assert late_in(photos, looks, matches, doubted).rows == ()


def test_a_photo_that_no_pair_fits_finds_none() -> None:
    """Its landmarks would be made of the matches of pairs, of which each is mostly wrong."""
    photos, looks, matches, model = walk()
    random = np.random.default_rng(1)
    mostly_wrong = []
    for pair in (p for p in matches if p.second == NUM_PLACED):
        rows, wrong = pair.rows.copy(), random.random(len(pair.rows)) < 0.58
        rows[wrong, 1] = random.integers(0, NUM_POINTS, wrong.sum())
        mostly_wrong.append(replace(pair, rows=rows))
    late = late_in(photos, looks, mostly_wrong, model)
    assert (late.rows, late.matches) == ((), ())
    assert late.views == model.views


def test_a_model_with_all_photos_gets_none() -> None:
    photos, looks, _, model = walk()
    late = late_in(photos[:NUM_PLACED], looks, [], replace(model, views=model.views[:NUM_PLACED]))
    assert (late.rows, late.matches) == ((), ())


def test_late_photos_are_adjusted_and_all_others_stay(tmp_path: Path) -> None:
    photos, looks, matches, model = walk()
    late = late_in(photos, looks, matches, model)
    shifted = list(late.views)
    for row in late.rows[:2]:
        view = late.views[row]
        assert view is not None
        pose = view.cam_from_world
        shifted[row] = View(CAMERA, Pose(pose.rotation, pose.translation + 0.01))
    some = Late((*shifted[: NUM_PLACED + 2], None, None), late.rows[:2], ())
    some = replace(some, matches=tuple(p for p in late.matches if p.second < NUM_PLACED + 2))
    grown = extend(photos, model, some, CONFIG, tmp_path)
    assert grown.views[:NUM_PLACED] == model.views[:NUM_PLACED]
    assert max(off(grown.views[row], row) for row in some.rows) < 0.005
    assert grown.views[NUM_PLACED + 2 :] == (None, None)
    seen = np.bincount(grown.observations.views, minlength=NUM_PHOTOS)
    assert (seen[list(some.rows)] > 200).all()
    # What photos of the model saw before, they still see, but for a few.
    before = np.bincount(model.observations.views, minlength=NUM_PHOTOS)
    assert (seen[:NUM_PLACED] >= 0.95 * before[:NUM_PLACED]).all()
