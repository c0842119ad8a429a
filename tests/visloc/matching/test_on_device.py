from __future__ import annotations

import numpy as np
import pytest
import torch

from visloc.matching import correspondences
from visloc.matching.correspondences import (
    Pairs,
    mutual_nearest_neighbours,
    mutual_nearest_neighbours_on,
    propose_landmarks,
)
from visloc.matching.products import EightBitRows

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA GPU")
DEVICES = ["cpu", pytest.param("cuda", marks=needs_gpu)]


def rows(rng: np.random.Generator, count: int, dim: int, largest: int) -> EightBitRows:
    """Rows of small numbers, so that many similarities are equal, and one of the largest."""
    values = rng.integers(-largest, largest + 1, (count, dim)).astype(np.int8)
    values[-1:] = -128
    return EightBitRows(values, 0.25)


def same(found: Pairs, expected: Pairs) -> bool:
    return all(
        np.array_equal(one, other) and one.dtype == other.dtype
        for one, other in zip(found, expected, strict=True)
    )


@pytest.mark.parametrize("name", DEVICES)
@pytest.mark.parametrize("max_ratio", [None, 0.9])
@pytest.mark.parametrize(("dim", "largest"), [(1, 2), (3, 2), (64, 1), (128, 127), (1041, 127)])
@pytest.mark.parametrize("most_products", [1, 20_000, 2**26])
def test_pairs_are_those_of_each_photo_alone(
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    max_ratio: float | None,
    dim: int,
    largest: int,
    most_products: int,
) -> None:
    monkeypatch.setattr(correspondences, "_MOST_PRODUCTS_ON_DEVICE", most_products)
    rng = np.random.default_rng(dim)
    query = rows(rng, 300, dim, largest)
    photos = [rows(rng, count, dim, largest) for count in (40, 0, 1, 257, 300)]
    found = mutual_nearest_neighbours_on(torch.device(name), query, photos, max_ratio)
    assert len(found) == len(photos)
    for photo, pairs in zip(photos, found, strict=True):
        assert same(pairs, mutual_nearest_neighbours(query, photo, max_ratio))


@pytest.mark.parametrize("name", DEVICES)
def test_nothing_matches_nothing(name: str) -> None:
    empty = EightBitRows(np.zeros((0, 4), np.int8), 1.0)
    full = EightBitRows(np.eye(4, dtype=np.int8), 1.0)
    device = torch.device(name)
    assert mutual_nearest_neighbours_on(device, full, []) == []
    for query, photo in ((empty, full), (full, empty), (empty, empty)):
        (pairs,) = mutual_nearest_neighbours_on(device, query, [photo])
        assert [len(part) for part in pairs] == [0, 0, 0]


@needs_gpu
def test_proposals_of_a_gpu_are_those_of_the_processor(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    query = rows(rng, 500, 64, 127)
    photos = [(rng.permutation(400), rows(rng, 400, 64, 127)) for _ in range(5)]
    on_gpu = propose_landmarks(query, photos)
    monkeypatch.setattr(correspondences, "has_cuda", lambda: False)
    on_processor = propose_landmarks(query, photos)
    for part in ("keypoints", "landmarks", "ranks", "similarities"):
        assert np.array_equal(getattr(on_gpu, part), getattr(on_processor, part))
