"""Points of a room, and of a thing that moves through it, seen from exact poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from mapping.methods.matching.stages import Matches
from mapping.methods.sparse.model import SfmPhoto, SparseModel
from mapping.methods.sparse.pair_agreement import contradicted_pairs, doubts_about_poses
from mapping.stages.landmarks import Observations, View
from visloc.geometry import Camera, Pose
from visloc.pose.reprojection import project

CAMERA = Camera("PINHOLE", 640, 480, (450.0, 450.0, 320.0, 240.0))
NUM_PHOTOS, NUM_ROOM, NUM_MOVING = 9, 200, 80
RANDOM = np.random.default_rng(0)
ROOM = RANDOM.uniform([-2, -1.5, 4], [2, 1.5, 9], (NUM_ROOM, 3))
THING = RANDOM.uniform([-0.5, -0.8, -0.3], [0.5, 0.8, 0.3], (NUM_MOVING, 3))
PAIRS = list(combinations(range(NUM_PHOTOS), 2))
MAX_ERROR_PX = 4.0


def pose_of(number: int) -> Pose:
    return Pose(np.eye(3), np.array([-0.2 * number, 0.05 * (number % 3), -0.1 * number]))


def thing_at(number: int) -> Sequence[float]:
    """It goes down, and away from the camera, while the camera goes ahead."""
    return (0.2 * number, -0.5 + 0.3 * number, 4.0 + 0.25 * number**1.2)


def photos() -> list[SfmPhoto]:
    """Keypoints of the room, then of the thing, off by 0.3 pixels."""
    found = []
    for number in range(NUM_PHOTOS):
        points = np.concatenate([ROOM, THING + thing_at(number)])
        pixels = project(CAMERA, pose_of(number).apply(points)) + RANDOM.normal(0, 0.3, (280, 2))
        keypoints = pixels.astype(np.float32)
        found.append(SfmPhoto(f"{number}.jpg", "cam", number, CAMERA, True, None, keypoints))
    return found


def matches(moving: Sequence[tuple[int, int]]) -> list[Matches]:
    """All pairs; of some of them, what moves was verified, and of the others the room."""
    thing, room = np.arange(NUM_ROOM, NUM_ROOM + NUM_MOVING), np.arange(NUM_ROOM)
    rows = {pair: thing if pair in moving else room for pair in PAIRS}
    return [
        Matches(*pair, np.column_stack([of, of]).astype(np.uint32)) for pair, of in rows.items()
    ]


def model(yaw_deg: float = 0.0) -> SparseModel:
    """The true poses, each turned by as much, to either side in turns."""
    views = []
    for number in range(NUM_PHOTOS):
        angle = np.deg2rad(yaw_deg) * (-1) ** number
        cos, sin = np.cos(angle), np.sin(angle)
        turn = np.array([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]])
        views.append(View(CAMERA, Pose(turn, np.zeros(3)) @ pose_of(number)))
    none = np.empty(0, np.int64)
    seen = Observations(none, none, none, np.empty((0, 2), np.float32))
    return SparseModel(tuple(views), ROOM, seen, np.zeros(NUM_ROOM, np.float32), False, {})


def test_pairs_of_what_moves_contradict_the_true_poses_and_no_others() -> None:
    moving = [(0, 3), (2, 5), (4, 8)]
    found, compared = contradicted_pairs(model(), photos(), matches(moving), MAX_ERROR_PX)
    assert [(pair.first, pair.second) for pair in found] == moving
    assert compared == len(PAIRS)


def test_many_contradicted_pairs_are_a_doubt_that_names_their_photos() -> None:
    moving = [(0, 3), (0, 4), (0, 5), (2, 5)]
    (doubt,) = doubts_about_poses(model(), photos(), matches(moving), MAX_ERROR_PX)
    assert doubt.kind == "matches"
    assert doubt.message.startswith("4 of 36 pairs of photos")
    assert doubt.photos[0] == "0.jpg"
    assert set(doubt.photos) == {"0.jpg", "2.jpg", "3.jpg", "4.jpg", "5.jpg"}


@pytest.mark.parametrize("moving", [[], [(0, 3), (2, 5), (4, 8)]])
def test_few_contradicted_pairs_are_no_doubt(moving: list[tuple[int, int]]) -> None:
    assert doubts_about_poses(model(), photos(), matches(moving), MAX_ERROR_PX) == ()


def test_poses_that_are_a_little_off_are_no_doubt_and_wrong_ones_are() -> None:
    taken, pairs = photos(), matches([])
    assert doubts_about_poses(model(yaw_deg=0.2), taken, pairs, MAX_ERROR_PX) == ()
    # One photo far from where it was taken contradicts all its pairs.
    lost = model()
    aside = View(CAMERA, Pose(np.eye(3), np.array([0.0, 1.0, 0.5])) @ pose_of(4))
    lost = replace(lost, views=(*lost.views[:4], aside, *lost.views[5:]))
    (doubt,) = doubts_about_poses(lost, taken, pairs, MAX_ERROR_PX)
    assert doubt.photos[0] == "4.jpg"


def test_photos_without_a_place_are_not_compared() -> None:
    alone = replace(model(), views=(*model().views[:2], *[None] * (NUM_PHOTOS - 2)))
    found, compared = contradicted_pairs(alone, photos(), matches([]), MAX_ERROR_PX)
    assert (found, compared) == ([], 1)
    nowhere = replace(model(), views=(None,) * NUM_PHOTOS)
    assert doubts_about_poses(nowhere, photos(), matches([]), MAX_ERROR_PX) == ()
