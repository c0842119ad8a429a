from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from visloc.features.descriptors.densevlad import DenseVlad, dense_root_sift
from visloc.types import LocalFeatures

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA GPU")
NO_FEATURES = LocalFeatures(
    np.empty((0, 2), np.float32),
    np.empty((0, 64), np.float32),
    np.empty(0, np.float32),
    np.empty(0, np.float32),
)


def texture(seed: int, height: int, width: int) -> NDArray[np.uint8]:
    """Squares of 8 px, the left third without any contrast."""
    rng = np.random.default_rng(seed)
    squares = rng.integers(0, 256, (height // 8 + 1, width // 8 + 1, 3), dtype=np.uint8)
    photo = squares.repeat(8, axis=0).repeat(8, axis=1)[:height, :width].copy()
    photo[:, : width // 3] = 100
    return photo


@pytest.mark.parametrize("name", ["cpu", pytest.param("cuda", marks=needs_gpu)])
@pytest.mark.parametrize("size", [(480, 640), (333, 501), (1200, 900), (64, 200), (33, 34)])
def test_the_vector_is_that_of_numpy(name: str, size: tuple[int, int]) -> None:
    vocabulary = {"vocabulary": dense_root_sift(texture(1, 480, 640))[5000::20]}
    photo = texture(0, *size)
    expected = DenseVlad().pool(photo, NO_FEATURES, vocabulary)
    found = DenseVlad(torch.device(name)).pool(photo, NO_FEATURES, vocabulary)
    assert (found.shape, found.dtype) == (expected.shape, np.float32)
    assert found @ expected == pytest.approx(1.0, abs=1e-3)
    again = DenseVlad(torch.device(name)).pool(photo, NO_FEATURES, vocabulary)
    assert np.array_equal(found, again)


@pytest.mark.parametrize("photo", [np.full((480, 640, 3), 7, np.uint8), texture(0, 31, 640)])
def test_a_photo_without_words_is_zero(photo: NDArray[np.uint8]) -> None:
    vocabulary = {"vocabulary": dense_root_sift(texture(1, 480, 640))[5000::20]}
    assert not DenseVlad(torch.device("cpu")).pool(photo, NO_FEATURES, vocabulary).any()


def test_it_says_what_computes_it() -> None:
    assert DenseVlad().computed_with is None
    assert DenseVlad(torch.device("cpu")).computed_with == f"torch {torch.__version__} on cpu"
