"""Spoiled photos: where a dot of the photo lands, and what that says about the camera."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.trust.queries import (
    corner,
    cut_to,
    enlarged_half,
    mirrored,
    print_corners,
    stretched,
    with_focal_length,
    with_print,
)
from visloc.geometry import Camera
from visloc.photos.reading import Photo

CAMERA = Camera("PINHOLE", 640, 480, (520.0, 530.0, 310.0, 250.0))
SCENE = Camera("SIMPLE_PINHOLE", 1280, 960, (1100.0, 640.0, 480.0))
# Pixels of the middle of a dot: in our convention the corner of the photo is (0, 0).
DOT = np.array([262.0, 214.0])


def dotted(at: NDArray[np.float64] = DOT) -> Photo:
    """A dark photo with a bright dot of 12 pixels."""
    rgb = np.zeros((480, 640, 3), np.uint8)
    left, top = (at - 6).astype(int)
    rgb[top : top + 12, left : left + 12] = 255
    return Photo(rgb)


def dot_of(photo: Photo) -> NDArray[np.float64]:
    """Return the middle of the light in a photo, in pixels of our convention."""
    light = photo.rgb[..., 0].astype(np.float64)
    y, x = np.mgrid[: photo.height, : photo.width] + 0.5
    return np.array([(light * x).sum(), (light * y).sum()]) / light.sum()


def ray(camera: Camera, pixel: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return where a pinhole camera looks, as x and y at depth 1."""
    fx, fy, cx, cy = camera.params
    return (pixel - [cx, cy]) / [fx, fy]


def test_a_wrong_focal_length_changes_nothing_else() -> None:
    photo, camera = with_focal_length(dotted(), CAMERA, 1.1)

    assert camera.params == pytest.approx((572.0, 583.0, 310.0, 250.0))
    assert np.array_equal(photo.rgb, dotted().rgb)
    distorted = Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, 0.05))
    assert with_focal_length(dotted(), distorted, 0.7)[1].params == (350.0, 320.0, 240.0, 0.05)


def test_a_mirror_turns_each_ray_to_the_other_side() -> None:
    photo, camera = mirrored(dotted(), CAMERA)

    seen, true = ray(camera, dot_of(photo)), ray(CAMERA, DOT)
    assert seen == pytest.approx([-true[0], true[1]])
    twice, same = mirrored(photo, camera)
    assert np.array_equal(twice.rgb, dotted().rgb)
    assert same == CAMERA


def test_an_enlarged_half_has_twice_the_focal_length() -> None:
    centred = Camera("PINHOLE", 640, 480, (520.0, 530.0, 320.0, 240.0))
    photo, camera = enlarged_half(dotted(), centred)

    assert (photo.width, photo.height, camera) == (640, 480, centred)
    _, true_camera = with_focal_length(photo, camera, 2.0)
    assert ray(true_camera, dot_of(photo)) == pytest.approx(ray(centred, DOT), abs=1e-4)


def test_a_corner_keeps_its_pixels_and_the_camera_of_the_whole() -> None:
    photo, camera = corner(dotted(), CAMERA)

    assert (photo.width, photo.height, camera) == (320, 240, CAMERA)
    assert dot_of(photo) == pytest.approx(DOT)


def test_a_stretched_photo_needs_another_focal_length_upwards_only() -> None:
    photo, camera = stretched(dotted(), CAMERA)

    assert (photo.width, photo.height) == (camera.width, camera.height) == (640, 360)
    seen, true = ray(camera, dot_of(photo)), ray(CAMERA, DOT)
    assert seen == pytest.approx([true[0], true[1] * 0.75], abs=1e-4)


@pytest.mark.parametrize("size", [(1280, 960), (320, 320), (700, 200)])
def test_a_cut_photo_has_the_camera_that_is_returned(size: tuple[int, int]) -> None:
    photo, camera = cut_to(dotted(), CAMERA, *size)

    assert (photo.width, photo.height) == (camera.width, camera.height) == size
    assert ray(camera, dot_of(photo)) == pytest.approx(ray(CAMERA, DOT), abs=2e-3)


@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
def test_a_print_lies_in_the_scene_and_is_as_wide_as_asked(share: float) -> None:
    random = np.random.default_rng(3)
    for _ in range(20):
        corners = print_corners(dotted(), SCENE, share, random)

        assert np.ptp(corners[:, 0]) == pytest.approx(share * SCENE.width)
        assert (corners >= 0).all()
        assert (corners <= [SCENE.width, SCENE.height]).all()
        sides = np.roll(corners, -1, axis=0) - corners
        following = np.roll(sides, -1, axis=0)
        turns = sides[:, 0] * following[:, 1] - sides[:, 1] * following[:, 0]
        assert (turns > 0).all()  # convex, and clockwise as the photo's own corners


@pytest.mark.parametrize("share", [0.3, 0.7])
def test_a_print_shows_the_photo_through_one_homography(share: float) -> None:
    corners = print_corners(dotted(), SCENE, share, np.random.default_rng(1))
    background = Photo(np.zeros((960, 1280, 3), np.uint8))

    scene, camera = with_print(background, SCENE, dotted(), corners)

    whole = np.array([[0, 0], [640, 0], [640, 480], [0, 480]], np.float32)
    homography = cv2.getPerspectiveTransform(whole, corners.astype(np.float32))
    x, y, w = homography @ [*DOT, 1.0]
    assert dot_of(scene) == pytest.approx([x / w, y / w], abs=0.5)
    assert camera == SCENE


def test_a_scene_keeps_what_the_print_does_not_cover() -> None:
    corners = print_corners(dotted(), SCENE, 0.5, np.random.default_rng(2))
    random = np.random.default_rng(0)
    background = Photo(random.integers(1, 255, (960, 1280, 3), dtype=np.uint8))

    scene, _ = with_print(background, SCENE, Photo(np.zeros((480, 640, 3), np.uint8)), corners)

    covered = (scene.rgb == 0).all(axis=2)
    assert np.array_equal(scene.rgb[~covered], background.rgb[~covered])
    x, y = corners[:, 0], corners[:, 1]
    area = abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2
    assert covered.sum() == pytest.approx(area, rel=0.01)
