"""Rays of pixels, against closed forms of cameras without other distortion."""

from __future__ import annotations

import numpy as np
import pytest

from visloc.geometry import Camera
from visloc.pose.reprojection import normalized_rays

WIDE = {
    "OPENCV_FISHEYE": (280.0, 280.0, 500.0, 500.0, 0, 0, 0, 0),
    "RADIAL_FISHEYE": (280.0, 500.0, 500.0, 0, 0),
    "THIN_PRISM_FISHEYE": (280.0, 280.0, 500.0, 500.0, 0, 0, 0, 0, 0, 0, 0, 0),
}


@pytest.mark.parametrize("model", WIDE)
def test_pixels_of_what_lies_beside_or_behind_a_camera_have_no_ray(model: str) -> None:
    camera = Camera(model, 1000, 1000, WIDE[model])
    angles = np.radians([0.0, 30.0, 60.0, 85.0, 89.0, 91.0, 95.0, 100.0])
    turns = np.radians([0.0, 45.0, 200.0])
    for turn in turns:
        side = np.array([np.cos(turn), np.sin(turn)])
        pixels = 500 + 280 * angles[:, None] * side  # of an equidistant lens
        rays = normalized_rays(camera, pixels)
        expected = np.tan(angles)[:, None] * side
        np.testing.assert_allclose(rays[:5, :2], expected[:5], rtol=1e-6, atol=1e-9)
        assert np.isnan(rays[5:]).all()


def test_a_lens_that_sees_straight_ahead_has_a_ray_for_each_pixel() -> None:
    camera = Camera("OPENCV", 640, 480, (525.0, 520.0, 319.0, 241.0, -0.28, 0.07, 1e-4, 2e-4))
    u, v = np.meshgrid(np.linspace(0, 640, 9), np.linspace(0, 480, 9))
    rays = normalized_rays(camera, np.column_stack([u.ravel(), v.ravel()]))
    assert np.isfinite(rays).all()
