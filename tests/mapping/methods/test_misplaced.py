"""A photo that stands in a wrong place is told by its matches, and those beside it are not."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from mapping.methods.matching import Matches
from mapping.methods.misplaced import misplaced
from mapping.methods.sparse_model import SfmPhoto
from mapping.stages.landmarks import View
from visloc.geometry import Camera, Pose
from visloc.pose.colmap import project

CAMERA = Camera("SIMPLE_PINHOLE", 640, 480, (450.0, 320.0, 240.0))
NUM_PHOTOS, NUM_POINTS, STEPS = 12, 300, 3


def row_of_photos() -> tuple[list[SfmPhoto], list[View | None], list[Matches]]:
    points = np.random.default_rng(0).uniform([-3, -2, 4], [3, 2, 9], (NUM_POINTS, 3))
    poses = [Pose(np.eye(3), np.array([-0.2 * i, 0.1 * (i % 2), 0.0])) for i in range(NUM_PHOTOS)]
    photos = [
        SfmPhoto(f"{row}.jpg", "cam", row, CAMERA, True, None, pixels.astype(np.float32))
        for row, pixels in enumerate(project(CAMERA, pose.apply(points)) for pose in poses)
    ]
    every = np.repeat(np.arange(NUM_POINTS, dtype=np.uint32)[:, None], 2, axis=1)
    pairs = combinations(range(NUM_PHOTOS), 2)
    matches = [Matches(a, b, every) for a, b in pairs if b - a <= STEPS]
    return photos, [View(CAMERA, pose) for pose in poses], matches


def moved(view: View | None, by: NDArray[np.float64]) -> View:
    assert view is not None
    pose = view.cam_from_world
    return View(view.camera, Pose(pose.rotation, pose.translation + by))


def test_photos_in_their_places_are_not_in_doubt() -> None:
    assert misplaced(*row_of_photos(), max_error_px=4.0) == ([], 1.0)


def test_photos_that_stand_wrong_are_in_doubt_and_at_most_their_partners() -> None:
    photos, views, matches = row_of_photos()
    for row in (0, 1):
        views[row] = moved(views[row], np.array([0.0, 0.4 + 0.3 * row, 0.3]))
    rows, share = misplaced(photos, views, matches, 4.0)
    assert {0, 1} <= set(rows) <= set(range(2 + STEPS))
    assert share < 0.9


def test_photos_without_a_place_say_nothing() -> None:
    photos, views, matches = row_of_photos()
    views[3] = None
    assert misplaced(photos, views, matches, 4.0) == ([], 1.0)


def test_when_most_photos_contradict_each_other_none_is_named() -> None:
    photos, views, matches = row_of_photos()
    views = [moved(view, np.array([0.0, 0.5 * i * i, 0.0])) for i, view in enumerate(views)]
    rows, share = misplaced(photos, views, matches, 4.0)
    assert rows == []
    assert share < 0.5
