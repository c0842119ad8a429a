"""Points seen from exact poses, beside keypoints that keep their pixels."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.methods.matching.fixed_things import Tally
from mapping.stages.camera_mask import CameraMask, are_masked
from visloc.geometry import Camera, Pose
from visloc.pose.reprojection import project

CAMERA = Camera("PINHOLE", 640, 480, (450.0, 450.0, 320.0, 240.0))
RANDOM = np.random.default_rng(3)
# A room, and hills that are as good as infinitely far away.
ROOM = RANDOM.uniform([-8, -3, 4], [8, 3, 14], (900, 3))
HILLS = RANDOM.uniform([-4e5, -3e5, 5e5], [4e5, 3e5, 6e5], (300, 3))
# Left, top, right and bottom of what is fixed to the picture.
BONNET = (160, 380, 480, 480)
NUM_FIXED = 200
CELL_PX = 640 / 24


def turned(yaw_deg: float, center: Sequence[float] = (0, 0, 0)) -> Pose:
    cos, sin = np.cos(np.deg2rad(yaw_deg)), np.sin(np.deg2rad(yaw_deg))
    rotation = np.array([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]])
    return Pose(rotation, -rotation @ np.asarray(center, float))


STANDING = [turned(0)] * 8
PAN = [turned(4.0 * n) for n in range(-4, 4)]
SIDEWAYS = [turned(0, (0.3 * n, 0, 0)) for n in range(8)]
AHEAD = [turned(0, (0, 0, 0.3 * n)) for n in range(8)]
CURVE = [turned(3.0 * n, (0.05 * n, 0, 0.3 * n)) for n in range(8)]


def mask_of(
    poses: Sequence[Pose],
    points: NDArray[np.float64] = ROOM,
    *,
    fixed: bool = False,
    calibrated: bool = True,
    moving: NDArray[np.float64] | None = None,
) -> CameraMask | None:
    """The mask of photos whose keypoints are off by 0.3 pixels; ``moving`` is where points are."""
    noise = np.random.default_rng(0)
    on_it = noise.uniform(BONNET[:2], BONNET[2:], (NUM_FIXED, 2))
    photos = []
    for number, pose in enumerate(poses):
        there = points if moving is None else np.concatenate([points, moving[number]])
        pixels = project(CAMERA, pose.apply(there))
        x, y = np.nan_to_num(pixels, nan=-1).T
        seen = (x >= 0) & (x < 640) & (y >= 0) & (y < 480)
        if fixed:
            seen &= (x < BONNET[0]) | (x > BONNET[2]) | (y < BONNET[1])
            pixels = np.concatenate([pixels, on_it])
            seen = np.concatenate([seen, np.ones(NUM_FIXED, bool)])
        photos.append((pixels + noise.normal(0, 0.3, pixels.shape), seen))
    tally = Tally.of(CAMERA)
    for (a, seen_a), (b, seen_b) in combinations(photos, 2):
        both = seen_a & seen_b
        wrong = noise.uniform(0, (640, 480), (2, 60, 2))
        matched = (np.concatenate([each[both], w]) for each, w in zip((a, b), wrong, strict=True))
        tally.add(CAMERA, *matched, 4.0, calibrated=calibrated)
    return tally.mask()


@pytest.mark.parametrize("calibrated", [True, False])
@pytest.mark.parametrize("poses", [PAN, CURVE], ids=["pan", "curve"])
def test_what_is_fixed_to_the_picture_is_masked_and_nothing_else(
    poses: list[Pose], calibrated: bool
) -> None:
    mask = mask_of(poses, fixed=True, calibrated=calibrated)
    assert mask is not None
    left, top, right, bottom = BONNET
    inner = RANDOM.uniform((left + 5, top + 5), (right - 5, bottom - 5), (500, 2))
    assert are_masked(CAMERA, mask, inner).mean() > 0.95
    # With a cell around it, and cells that it covers in part.
    most = (right - left + 4 * CELL_PX) * (bottom - top + 2 * CELL_PX) / (640 * 480)
    assert mask.mean() <= most
    above = RANDOM.uniform((0, 0), (640, top - 2 * CELL_PX - 1), (500, 2))
    assert not are_masked(CAMERA, mask, above).any()


@pytest.mark.parametrize("calibrated", [True, False])
@pytest.mark.parametrize("poses", [STANDING, PAN, SIDEWAYS, AHEAD, CURVE])
@pytest.mark.parametrize("points", [ROOM, np.concatenate([ROOM, HILLS])], ids=["near", "far"])
def test_without_such_a_thing_nothing_is_masked(
    poses: list[Pose], points: NDArray[np.float64], calibrated: bool
) -> None:
    assert mask_of(poses, points, calibrated=calibrated) is None


def test_a_place_before_a_standing_camera_stays_though_somebody_walks_there() -> None:
    person = RANDOM.uniform([-0.4, -1, 3.5], [0.4, 1, 4.0], (120, 3))
    walk = person + np.arange(8)[:, None, None] * (0.4, 0, 0.1) - (1.6, 0, 0)
    assert mask_of(STANDING, moving=walk) is None


def test_a_film_that_stands_most_of_the_time_keeps_all_of_its_place() -> None:
    assert mask_of([*STANDING, *CURVE[1:4]]) is None


def test_few_pairs_tell_nothing() -> None:
    assert mask_of(CURVE[:3], fixed=True) is None


def test_tallies_of_parts_are_those_of_the_whole() -> None:
    one, other = Tally.of(CAMERA), Tally.of(CAMERA)
    one.moved[2, 3], other.moved[2, 3], other.against[0, 0], one.pairs[1, 1] = 2, 3, 4, 5
    both = one + other
    assert (both.moved[2, 3], both.against[0, 0], both.pairs[1, 1]) == (5, 4, 5)


def test_keypoints_on_the_border_have_a_cell() -> None:
    mask = np.zeros((18, 24), dtype=bool)
    mask[-1, -1] = True
    corners = np.array([[640.0, 480.0], [0.0, 0.0], [-1.0, 480.0]])
    assert are_masked(CAMERA, mask, corners).tolist() == [True, False, False]
