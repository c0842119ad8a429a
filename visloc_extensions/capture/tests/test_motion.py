from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.mapping.importers.conftest import panned, texture
from visloc_extensions.capture.motion import measure_motion
from visloc_extensions.films.video import frames_of


def test_the_path_is_how_far_the_picture_moved(make_video: Callable[..., Path]) -> None:
    found = measure_motion(frames_of(make_video(panned(30, step=4))))
    assert np.allclose(np.diff(found.seconds), 0.1)
    # 29 steps of 4 of 320 pixels.
    assert found.path[-1] == pytest.approx(29 * 4 / 320, rel=0.05)
    assert (np.diff(found.path) >= 0).all()


def test_trembling_does_not_add_up(make_video: Callable[..., Path]) -> None:
    wall = texture(340, 240)
    pictures = [wall[:, (i % 2) * 2 : (i % 2) * 2 + 320].copy() for i in range(60)]
    assert measure_motion(frames_of(make_video(pictures))).path[-1] < 0.02


def test_a_cut_counts_as_moved(make_video: Callable[..., Path]) -> None:
    pictures = [texture(320, 240, seed=0)] * 5 + [texture(320, 240, seed=9)] * 5
    path = measure_motion(frames_of(make_video(pictures))).path
    assert path[4] < 0.01
    assert path[5] > 0.1


def test_a_blurred_frame_is_less_sharp(make_video: Callable[..., Path]) -> None:
    pictures = panned(9, step=4)
    pictures[4] = np.asarray(cv2.blur(pictures[4], (15, 1)), np.uint8)
    sharpness = measure_motion(frames_of(make_video(pictures))).sharpness
    assert sharpness[4] < 0.5 * np.median(sharpness)


def test_a_bare_wall_is_no_error(make_video: Callable[..., Path]) -> None:
    pictures = [np.full((240, 320, 3), 200, np.uint8)] * 10
    assert measure_motion(frames_of(make_video(pictures))).path[-1] == pytest.approx(0.0, abs=0.02)
