from __future__ import annotations

import cv2
import numpy as np
import pytest

from visloc.features.framing import (
    Framing,
    turned_picture,
    turned_points,
    turned_size,
    unturned_points,
)
from visloc.features.local.sift import SiftExtractor
from visloc.features.resolution import extract_features
from visloc.photos.reading import Photo

WIDTH, HEIGHT = 90, 60
# The middle of each dot, in pixels from the corner of the picture.
DOTS = np.array([[20.5, 10.5], [70.5, 15.5], [45.5, 50.5]])


def dotted() -> np.ndarray:
    rgb = np.full((HEIGHT, WIDTH, 3), 30, np.uint8)
    for x, y in (DOTS - 0.5).astype(int):
        rgb[y - 1 : y + 2, x - 1 : x + 2] = 255
    return rgb


@pytest.mark.parametrize("degrees", [0, 30, 45, 90, 135, 180, 270, 315])
def test_points_move_with_the_picture_and_back(degrees: int) -> None:
    turned = turned_picture(dotted(), degrees)
    width, height = turned_size(WIDTH, HEIGHT, degrees)
    assert turned.shape == (height, width, 3)
    for x, y in turned_points(DOTS, degrees, WIDTH, HEIGHT):
        left, top = int(x) - 5, int(y) - 5
        patch = turned[top : top + 11, left : left + 11, 0].astype(float) - 30
        patch[patch < 40] = 0
        rows, columns = np.mgrid[:11, :11] + 0.5
        centre = [(columns * patch).sum() / patch.sum(), (rows * patch).sum() / patch.sum()]
        assert np.allclose(centre, [x - left, y - top], atol=0.15)
    moved = turned_points(DOTS, degrees, WIDTH, HEIGHT)
    assert np.allclose(unturned_points(moved, degrees, WIDTH, HEIGHT), DOTS)


def test_turning_is_clockwise() -> None:
    # What was at the top is to the right after a quarter turn.
    assert np.allclose(turned_points(np.array([[45.0, 0.0]]), 90, WIDTH, HEIGHT), [[60.0, 45.0]])


def test_a_quarter_turn_keeps_every_pixel() -> None:
    rgb = np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    assert np.array_equal(turned_picture(rgb, 90), cv2.rotate(rgb, cv2.ROTATE_90_CLOCKWISE))
    assert np.array_equal(turned_picture(turned_picture(rgb, 90), 270), rgb)


@pytest.mark.parametrize("degrees", [90, 180, 270, 45])
def test_features_of_a_turned_picture_lie_in_the_stored_pixels(degrees: int) -> None:
    random = np.random.default_rng(5)
    rgb = cv2.GaussianBlur(random.integers(0, 256, (240, 320, 3), dtype=np.uint8), (0, 0), 3)
    rgb = cv2.normalize(rgb, rgb, 0, 255, cv2.NORM_MINMAX)
    photo, extractor = Photo(rgb, exif_orientation=6), SiftExtractor()
    straight, _ = extract_features(photo, extractor, max_keypoints=300)
    framing = Framing((480, 360), degrees)
    turned, picture = extract_features(photo, extractor, max_keypoints=300, framing=framing)
    assert picture.shape[:2] == turned_size(360, 480, degrees)[::-1]
    apart = np.linalg.norm(straight.keypoints[:, None] - turned.keypoints[None], axis=2)
    # Most keypoints are found again, at their places; SIFT stands turns and scales.
    assert np.mean(apart.min(axis=1) < 1.0) > 0.7
    assert (turned.keypoints >= 0).all()
    assert (turned.keypoints <= [320, 240]).all()
