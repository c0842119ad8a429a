"""Two places in the same space, seen with exact poses: which photos show which."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.methods.sparse.contradictions import ModelPhoto, Places, find_places
from mapping.stages.landmarks import View
from visloc.geometry import Camera, Pose
from visloc.pose.reprojection import project

CAMERA = Camera("SIMPLE_PINHOLE", 640, 480, (450.0, 320.0, 240.0))
NUM_POINTS, PHOTOS_EACH, DETECTED = 600, 8, 0.8


def poses(seed: int) -> list[Pose]:
    """A walk sideways along the wall, up to 10 cm beside the line."""
    random = np.random.default_rng(seed)
    ways = [[-0.25 * k, *random.uniform(-0.1, 0.1, 2)] for k in range(PHOTOS_EACH)]
    return [Pose(np.eye(3), np.array(way)) for way in ways]


def walks(
    shares: list[NDArray[np.int64]], points: NDArray[np.float64], *, off: float = 0.0
) -> tuple[list[ModelPhoto], NDArray[np.float64]]:
    """Photos of walks past the points that each one names, of which a photo finds some.

    Args:
        off: how far the pose of each second walk's photo is off, in the model.
    """
    random = np.random.default_rng(3)
    looks = random.normal(size=(len(points), 64))
    looks = np.rint(127 * looks / np.abs(looks).max()).astype(np.int8)
    found = []
    for number, rows in enumerate(shares):
        for pose in poses(number):
            pixels = project(CAMERA, pose.apply(points[rows]))
            inside = ((pixels > 0) & (pixels < (640, 480))).all(axis=1)
            seen = inside & (random.random(len(rows)) < DETECTED)
            moved = Pose(np.eye(3), pose.translation + off * number * np.eye(3)[0])
            found.append((View(CAMERA, moved), pixels[seen], rows[seen]))
    tracks = np.bincount(np.concatenate([rows for *_, rows in found]), minlength=len(points))
    photos = []
    for view, pixels, rows in found:
        observing = np.flatnonzero(tracks[rows] >= 2)
        photos.append(ModelPhoto(view, pixels, looks[rows], rows[observing], observing))
    return photos, points


def some_points() -> NDArray[np.float64]:
    return np.random.default_rng(0).uniform([-3, -2, 4], [4, 2, 6], (NUM_POINTS, 3))


def told_apart(places: Places) -> NDArray[np.bool_]:
    num = len(places.groups)
    return np.array([[places.tell_apart(a, b) for b in range(num)] for a in range(num)])


@pytest.mark.parametrize("share", [0.12, 0.25, 0.5])
def test_photos_of_two_places_in_one_space_are_told_apart(share: float) -> None:
    both = np.arange(round(share * NUM_POINTS))
    own = np.arange(len(both), NUM_POINTS)
    half = len(own) // 2
    photos, points = walks(
        [np.concatenate([both, own[:half]]), np.concatenate([both, own[half:]])], some_points()
    )
    places = find_places(photos, points)
    across = np.arange(2 * PHOTOS_EACH) // PHOTOS_EACH
    np.testing.assert_array_equal(told_apart(places), across[:, None] != across)
    assert set(places.doubted().tolist()) in ({*range(8)}, {*range(8, 16)})


@pytest.mark.parametrize("off", [0.0, 0.04])  # metres; 4 px in the picture
def test_a_place_walked_twice_is_one(off: float) -> None:
    all_points = np.arange(NUM_POINTS)
    places = find_places(*walks([all_points, all_points], some_points(), off=off))
    assert not told_apart(places).any()
    assert len(places.doubted()) == 0


def test_a_tenth_that_stood_elsewhere_the_second_time_is_no_other_place() -> None:
    stays = np.arange(round(0.8 * NUM_POINTS))
    first, second = np.split(np.arange(len(stays), NUM_POINTS), 2)
    places = find_places(
        *walks([np.concatenate([stays, first]), np.concatenate([stays, second])], some_points())
    )
    assert not told_apart(places).any()


def test_no_photos_are_no_places() -> None:
    places = find_places([], np.empty((0, 3)))
    assert len(places.groups) == len(places.doubted()) == 0


def test_photos_that_see_nothing_are_not_doubted() -> None:
    none = np.empty(0, np.int64)
    blind = ModelPhoto(
        View(CAMERA, Pose.identity()), np.empty((0, 2)), np.empty((0, 64), np.int8), none, none
    )
    assert len(find_places([blind] * 5, np.empty((0, 3))).doubted()) == 0
