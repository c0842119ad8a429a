"""Retrieval by every operator, by some of the descriptors, and what photo weights do to both."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import visloc.retrieval.index as retrieval
from tests.visloc.retrieval.made_lists import inverted
from visloc.options import Fusion
from visloc.retrieval.fusion import LateFusion
from visloc.retrieval.index import GlobalRows, retrieve

EVERY = pytest.mark.parametrize("fusion", Fusion)
NUM, DIM = 400, 16


def units(rng: np.random.Generator, *shape: int) -> NDArray[np.float32]:
    rows = rng.normal(size=shape)
    return (rows / np.linalg.norm(rows, axis=-1, keepdims=True)).astype(np.float32)


@pytest.fixture(scope="module")
def index() -> dict[str, GlobalRows]:
    rng = np.random.default_rng(3)
    return {name: GlobalRows(units(rng, NUM, DIM)) for name in ("a", "b", "c")}


@pytest.fixture(scope="module")
def query(index: dict[str, GlobalRows]) -> dict[str, NDArray[np.float32]]:
    """Much like photo 7 under every descriptor."""
    rng = np.random.default_rng(4)
    rows = {name: rows[7] + 0.3 * units(rng, DIM) for name, rows in index.items()}
    return {name: row / np.linalg.norm(row) for name, row in rows.items()}


@EVERY
def test_what_every_descriptor_likes_best_comes_first(
    index: dict[str, GlobalRows], query: dict[str, NDArray[np.float32]], fusion: Fusion
) -> None:
    found = retrieve(query, index, 20, fusion=LateFusion(fusion))
    assert found.images[0] == 7
    assert len(set(found.images.tolist())) == 20
    assert (np.diff(found.scores) <= 0).all()
    assert list(found.similarities) == ["a", "b", "c"]


@EVERY
def test_one_descriptor_alone_ranks_by_its_cosines_and_needs_no_other(
    index: dict[str, GlobalRows], query: dict[str, NDArray[np.float32]], fusion: Fusion
) -> None:
    alone = LateFusion(fusion, {"b": 3.0})
    found = retrieve({"b": query["b"]}, index, NUM, fusion=alone)
    expected = retrieve({"b": query["b"]}, {"b": index["b"]}, NUM)
    assert np.array_equal(found.images, expected.images)
    assert np.array_equal(found.scores, expected.similarities["b"])
    assert list(found.similarities) == ["b"]


def test_a_descriptor_that_is_left_out_changes_nothing(
    index: dict[str, GlobalRows], query: dict[str, NDArray[np.float32]]
) -> None:
    some = retrieve(query, index, 20, fusion=LateFusion(weights={"a": 2.0, "c": 2.0}))
    both = {name: index[name] for name in ("a", "c")}
    assert np.array_equal(some.scores, retrieve(query, both, 20).scores)
    assert np.array_equal(some.images, retrieve(query, both, 20).images)


@EVERY
def test_photos_of_no_weight_never_come_and_equal_weights_change_nothing(
    index: dict[str, GlobalRows], query: dict[str, NDArray[np.float32]], fusion: Fusion
) -> None:
    late = LateFusion(fusion)
    plain = retrieve(query, index, NUM, fusion=late)
    halves = retrieve(query, index, NUM, np.full(NUM, 0.5), late)
    assert np.array_equal(halves.images, plain.images)
    assert np.array_equal(halves.scores, plain.scores)

    allowed = (np.arange(NUM) % 3 == 0).astype(np.float64)
    some = retrieve(query, index, 30, allowed, late)
    kept = plain.images[allowed[plain.images] > 0][:30]
    assert np.array_equal(some.images, kept)
    assert len(retrieve(query, index, 30, np.zeros(NUM), late).images) == 0


@EVERY
def test_of_two_photos_that_look_alike_the_heavier_comes_first(
    index: dict[str, GlobalRows], query: dict[str, NDArray[np.float32]], fusion: Fusion
) -> None:
    twice = {name: GlobalRows(rows.values[[7, 7, 1, 2]]) for name, rows in index.items()}
    weights = np.array([0.6, 0.9, 1.0, 1.0])
    found = retrieve(query, twice, 4, weights, LateFusion(fusion)).images.tolist()
    assert found.index(1) < found.index(0)


@EVERY
def test_large_maps_rank_what_is_proposed_as_if_that_were_all(
    index: dict[str, GlobalRows],
    query: dict[str, NDArray[np.float32]],
    fusion: Fusion,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(retrieval, "_MAX_ALLOWED_EXACT", 50)
    monkeypatch.setattr(retrieval, "_MAX_DOUBTFUL", 0)
    monkeypatch.setattr(retrieval, "_MIN_PROPOSED", 60)
    monkeypatch.setattr(retrieval, "_PROPOSED_PER_RESULT", 1)
    large = {
        name: GlobalRows(rows.values, inverted=inverted(rows[:], tmp_path / name))
        for name, rows in index.items()
    }
    late = LateFusion(fusion, {"a": 1.0, "c": 2.0})
    found = retrieve(query, large, 20, fusion=late)
    assert found.images[0] == 7
    assert len(set(found.images.tolist())) == 20
    assert (np.diff(found.scores) <= 0).all()

    allowed = np.zeros(NUM)
    allowed[5:300] = 1.0
    near = retrieve(query, large, 20, allowed, late)
    assert near.images[0] == 7
    assert ((near.images >= 5) & (near.images < 300)).all()
    assert len(retrieve(query, large, 20, np.zeros(NUM), late).images) == 0


@EVERY
def test_a_blank_query_gives_the_first_photos_of_the_map(
    index: dict[str, GlobalRows], fusion: Fusion
) -> None:
    blank = {name: np.zeros(DIM, np.float32) for name in index}
    found = retrieve(blank, index, 5, fusion=LateFusion(fusion))
    assert found.images.tolist() == [0, 1, 2, 3, 4]
    assert np.isfinite(found.scores).all()
