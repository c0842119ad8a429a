from __future__ import annotations

import cv2
import numpy as np
import pytest

from visloc.features.local.sift import MAX_LONG_SIDE_PX, load_sift


def _image_with_blob(height: int, width: int, x: float, y: float, sigma: float) -> np.ndarray:
    """Draw a bright Gaussian blob centred at (x, y); the top-left pixel's centre is (.5, .5)."""
    rows, columns = np.mgrid[:height, :width] + 0.5
    blob = np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * sigma**2))
    return np.repeat((40 + 180 * blob).astype(np.uint8)[:, :, None], 3, axis=2)


@pytest.mark.parametrize("center", [(60.5, 40.5), (61.0, 40.25), (75.75, 52.0)])
def test_blob_is_found_at_its_center(center: tuple[float, float]) -> None:
    features = load_sift().extract(_image_with_blob(100, 140, *center, 4.0), max_keypoints=10)
    assert len(features) >= 1
    np.testing.assert_allclose(features.keypoints[0], center, atol=0.05)


def test_blob_in_a_photo_that_is_shrunk_is_found_at_its_center() -> None:
    height, width = 600, 2 * MAX_LONG_SIDE_PX + 10
    center = (2000.3, 251.7)
    rgb = _image_with_blob(height, width, *center, 12.0)
    features = load_sift().extract(rgb, max_keypoints=10)
    np.testing.assert_allclose(features.keypoints[0], center, atol=0.15)


def test_size_of_the_patch_follows_the_size_of_the_blob() -> None:
    small, large = (
        load_sift().extract(_image_with_blob(300, 300, 150.5, 150.5, sigma), max_keypoints=1)
        for sigma in (5.0, 10.0)
    )
    assert large.scales[0] / small.scales[0] == pytest.approx(2.0, rel=0.1)


def test_descriptors_are_the_square_roots_of_l1_normalized_sift() -> None:
    generator = np.random.default_rng(0)
    noise = cv2.GaussianBlur(generator.uniform(0, 255, (120, 160, 3)), (0, 0), 2.0)
    rgb = cv2.normalize(noise, np.empty_like(noise), 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    features = load_sift().extract(rgb, max_keypoints=500)
    sift = cv2.SIFT.create(enable_precise_upscale=True)
    found, plain = sift.detectAndCompute(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), None)
    assert len(found) == len(features) > 50
    for point, row in zip(found, plain, strict=True):
        same = np.abs(features.keypoints - (np.array(point.pt) + 0.5)).max(axis=1) < 1e-3
        cosines = features.descriptors[same] @ np.sqrt(row / row.sum())
        assert cosines.max() == pytest.approx(1.0, abs=1e-4)
