"""Photos that benchmarks change: the same each time, and with a camera that fits."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.change.kinds import KINDS, changed
from visloc.geometry import Camera
from visloc.photos.reading import Photo

CAMERA = Camera("PINHOLE", 132, 100, (110.0, 110.0, 66.0, 50.0))


def photo() -> Photo:
    random = np.random.default_rng(3)
    return Photo(np.kron(random.integers(0, 256, (25, 33, 3)), np.ones((4, 4, 1))).astype(np.uint8))


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_a_changed_photo_is_another_one_and_always_the_same(kind: str) -> None:
    before = photo()
    first, camera = changed(kind, 1, "a.jpg", before, CAMERA)
    again, _ = changed(kind, 1, "a.jpg", before, CAMERA)
    assert np.array_equal(first.rgb, again.rgb)
    assert (camera.width, camera.height) == (first.width, first.height)
    if first.width == before.width:
        apart = np.abs(first.rgb.astype(int) - before.rgb).mean()
        assert apart > 3.0
    assert np.ptp(first.rgb) > 0
