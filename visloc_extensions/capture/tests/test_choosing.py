from __future__ import annotations

import numpy as np
import pytest

from visloc_extensions.capture.choosing import choose_frames
from visloc_extensions.capture.motion import Motion


def motion(path: list[float], sharpness: list[float] | None = None) -> Motion:
    seconds = np.arange(len(path)) / 10
    sharp = np.full(len(path), 100.0) if sharpness is None else np.array(sharpness)
    return Motion(seconds, sharp, np.array(path))


def test_one_frame_stands_for_a_camera_that_stands_still() -> None:
    chosen = choose_frames(motion([0.0] * 20 + [0.03] * 20), most=100)
    assert len(chosen.rows) == 2
    assert chosen.rows[0] < 20 <= chosen.rows[1]


def test_the_sharpest_of_a_stretch_is_taken() -> None:
    sharpness = [100.0] * 30
    sharpness[4], sharpness[17] = 120.0, 130.0
    chosen = choose_frames(motion([0.002 * i for i in range(30)], sharpness), most=100)
    assert {4, 17} <= set(chosen.rows.tolist())
    assert len(chosen.rows) == 3  # 0.058 in stretches of 0.02


@pytest.mark.parametrize("most", [2, 7, 50, 200])
def test_no_more_frames_than_allowed_and_evenly_spread(most: int) -> None:
    path = np.cumsum(np.random.default_rng(0).uniform(0, 0.1, 400)).tolist()
    rows = choose_frames(motion(path), most=most).rows
    assert most // 2 <= len(rows) <= most
    gaps = np.diff(np.array(path)[rows])
    assert len(gaps) == 0 or gaps.max() <= 2.1 * (path[-1] / (len(rows) - 1)) + 0.1


def test_a_blurred_frame_goes_where_its_neighbours_overlap() -> None:
    sharpness = [100.0] * 20
    sharpness[10] = 5.0
    chosen = choose_frames(motion([0.03 * i for i in range(20)], sharpness), most=100)
    assert 10 not in chosen.rows
    assert chosen.blurred.tolist() == [i == 10 for i in range(20)]


def test_a_blurred_frame_stays_where_a_gap_would_open() -> None:
    sharpness = [100.0] * 20
    sharpness[10] = 5.0
    chosen = choose_frames(motion([0.12 * i for i in range(20)], sharpness), most=100)
    assert 10 in chosen.rows


def test_wanted_moments_are_taken_in_any_case() -> None:
    chosen = choose_frames(motion([0.0] * 30), most=5, wanted_s=[1.04, 2.5])
    assert {10, 25} <= set(chosen.rows.tolist())
