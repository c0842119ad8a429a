from __future__ import annotations

import numpy as np
import pytest

from visloc.features.resolution import Resolution, WorkingResolution, resized
from visloc.geometry import Camera


def film(width: int, focal: float | None) -> Resolution:
    return Resolution(width, focal)


def of(*photos: Resolution, most_px: int | None = 1280) -> WorkingResolution:
    return WorkingResolution.of(photos, {} if most_px is None else {"max_long_side_px": most_px})


KITCHEN = of(film(640, 525.0))


def test_a_photo_of_the_maps_own_camera_is_left_alone() -> None:
    assert KITCHEN.feature_size(film(640, 525.0), 640, 480) is None
    assert KITCHEN.feature_size(film(640, 560.0), 640, 480) is None
    assert KITCHEN.finer(film(640, 560.0)) == 1.0


@pytest.mark.parametrize("times", [2, 2.5, 4])
def test_the_same_view_with_more_pixels_has_the_maps_size(times: float) -> None:
    photo = film(640 * times, 525.0 * times)
    size = KITCHEN.feature_size(photo, round(640 * times), round(480 * times))
    assert size == (640, 480)
    assert KITCHEN.finer(photo) == pytest.approx(times)


@pytest.mark.parametrize(("times", "whole"), [(2.95, 3), (6.25, 6), (1.04, 1)])
def test_reductions_near_a_whole_number_are_whole(times: float, whole: int) -> None:
    width, height = round(640 * times), round(480 * times)
    expected = None if whole == 1 else (round(width / whole), round(height / whole))
    assert KITCHEN.feature_size(film(640 * times, 525.0 * times), width, height) == expected
    assert KITCHEN.finer(film(640 * times, 525.0 * times)) == whole


def test_a_photo_on_its_side_is_reduced_as_much() -> None:
    assert KITCHEN.feature_size(film(2560, 2100.0), 1920, 2560) == (480, 640)


def test_a_small_photo_is_left_alone() -> None:
    photo = film(320, 262.5)
    assert KITCHEN.feature_size(photo, 320, 240) is None
    assert KITCHEN.finer(photo) == 1.0


def test_pixels_per_radian_count_and_not_the_width() -> None:
    tele, wide = film(640, 1050.0), film(1280, 525.0)
    assert KITCHEN.feature_size(tele, 640, 480) == (320, 240)
    assert KITCHEN.finer(tele) == pytest.approx(2.0)
    assert KITCHEN.feature_size(wide, 1280, 960) is None


def test_without_a_camera_the_width_counts() -> None:
    assert KITCHEN.feature_size(film(1280, None), 1280, 960) == (640, 480)
    assert KITCHEN.finer(film(1280, None)) == pytest.approx(2.0)


def test_what_a_network_shrinks_alike_is_reduced_to_the_maps_size() -> None:
    phone = of(film(4000, 3000.0))
    assert phone.feature_size(film(4000, 3000.0), 4000, 3000) is None
    assert phone.feature_size(film(8000, 6000.0), 8000, 6000) == (4000, 3000)
    # A turned picture is made beside the photo, and askew a long one has many times its pixels.
    assert phone.feature_size(film(4000, 3000.0), 4000, 3000, turned=45) == (1333, 1000)
    assert phone.finer(film(8000, 6000.0)) == pytest.approx(2.0)
    # What the network saw of the map's photos is as fine as this photo.
    assert phone.feature_size(film(1280, 960.0), 1280, 960) is None
    assert phone.finer(film(1280, 960.0)) == 1.0


def test_the_finest_camera_of_a_quarter_of_the_photos_counts() -> None:
    small, large = film(640, 500.0), film(4000, 3000.0)
    mixed = of(small, large, small, large)
    assert mixed.feature_size(large, 4000, 3000) is None
    assert mixed.feature_size(small, 640, 480) is None
    mixed = of(small, large, small, small, small)
    assert mixed.feature_size(large, 4000, 3000) == (667, 500)
    assert mixed.finer(large) == pytest.approx(6.0)


@pytest.mark.parametrize("focal", [1e-300, 1e-9, 1.0, 1e9, 1e300])
@pytest.mark.parametrize("width", [1, 20, 640, 16384])
@pytest.mark.parametrize("most_px", [1280, None])
def test_no_camera_asks_for_a_picture_of_nothing_or_without_end(
    focal: float, width: int, most_px: int | None
) -> None:
    working = of(film(640, 525.0), most_px=most_px)
    size = working.feature_size(film(width, focal), width, max(1, width // 20))
    for side in size or (1,):
        assert 1 <= side <= max(1280, width)
    if size is not None:
        assert max(size) >= min(320, width)
    # Where the matches of a whole photo lie within a threshold, noise has a pose.
    assert 1.0 <= working.finer(film(width, focal)) <= max(1.0, width / 320)


def test_the_resolution_of_a_camera_is_its_focal_length() -> None:
    camera = Camera("PINHOLE", 640, 480, (500.0, 510.0, 320.0, 240.0))
    assert Resolution.of(camera) == Resolution(640, 505.0)
    assert Resolution.of(camera, known=False) == Resolution(640, None)


def test_pixels_that_were_repeated_come_back_as_they_were() -> None:
    rgb = np.random.default_rng(3).integers(0, 256, (30, 40, 3), dtype=np.uint8)
    assert np.array_equal(resized(rgb.repeat(4, 0).repeat(4, 1), 40, 30), rgb)
    assert resized(rgb, 40, 30) is rgb
