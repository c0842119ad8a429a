from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from visloc.retrieval.index import GlobalRows, Retrieved, retrieve

Vectors = dict[str, NDArray[np.float32]]
Index = dict[str, GlobalRows]


def units(rng: np.random.Generator, *shape: int) -> NDArray[np.float32]:
    vectors = rng.normal(size=shape)
    return (vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)).astype(np.float32)


@st.composite
def searches(draw: st.DrawFn) -> tuple[Vectors, Index, int]:
    """A query, an index with rows that repeat, and how many to return."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    num, dim = draw(st.integers(1, 30)), draw(st.integers(1, 4))
    names = draw(st.sampled_from([("a",), ("a", "b")]))
    rows = rng.integers(0, num, num)  # some photos look just the same
    query = {name: units(rng, dim) for name in names}
    index = {name: GlobalRows(units(rng, num, dim)[rows]) for name in names}
    return query, index, draw(st.integers(1, 40))


def weights_of(seed: int, num: int) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    return rng.uniform(0.05, 1.0, num) * rng.integers(0, 2, num)


def same(a: Retrieved, b: Retrieved) -> bool:
    return (
        np.array_equal(a.images, b.images)
        and np.array_equal(a.scores, b.scores)
        and all(
            np.array_equal(a.similarities[name], b.similarities[name]) for name in a.similarities
        )
    )


@settings(max_examples=150, deadline=None, derandomize=True)
@given(search=searches(), seed=st.integers(0, 1000))
def test_excluded_photos_never_come_and_all_others_may(
    search: tuple[Vectors, Index, int], seed: int
) -> None:
    query, index, top_k = search
    num = len(index["a"])
    weights = weights_of(seed, num)
    found = retrieve(query, index, top_k, weights)
    assert len(found.images) == min(top_k, np.count_nonzero(weights))
    assert (weights[found.images] > 0).all()
    assert len(set(found.images.tolist())) == len(found.images)
    assert same(found, retrieve(query, index, top_k, weights.copy()))
    # Scores and similarities are those that the photos have without weights.
    plain = retrieve(query, index, num)
    score = dict(zip(plain.images.tolist(), plain.scores.tolist(), strict=True))
    assert [score[i] for i in found.images.tolist()] == found.scores.tolist()
    for name, values in plain.similarities.items():
        by_image = dict(zip(plain.images.tolist(), values.tolist(), strict=True))
        kept = found.similarities[name].tolist()
        assert [by_image[i] for i in found.images.tolist()] == kept


@settings(max_examples=100, deadline=None, derandomize=True)
@given(search=searches(), weight=st.sampled_from([1.0, 0.5, 1e-3]))
def test_equal_weights_change_nothing(search: tuple[Vectors, Index, int], weight: float) -> None:
    query, index, top_k = search
    num = len(index["a"])
    assert same(retrieve(query, index, top_k, np.full(num, weight)), retrieve(query, index, top_k))


@settings(max_examples=100, deadline=None, derandomize=True)
@given(search=searches(), seed=st.integers(0, 1000))
def test_of_two_photos_the_one_that_looks_and_counts_more_comes_first(
    search: tuple[Vectors, Index, int], seed: int
) -> None:
    query, index, _ = search
    num = len(index["a"])
    weights = weights_of(seed, num)
    found = retrieve(query, index, num, weights)
    for rank, image in enumerate(found.images):
        after = found.images[rank + 1 :]
        better = (found.scores[rank + 1 :] > found.scores[rank]) & (
            weights[after] >= weights[image]
        )
        assert not better.any()


def test_nothing_allowed_gives_nothing() -> None:
    rng = np.random.default_rng(0)
    found = retrieve({"a": units(rng, 3)}, {"a": GlobalRows(units(rng, 5, 3))}, 4, np.zeros(5))
    assert found.images.tolist() == found.scores.tolist() == found.similarities["a"].tolist() == []


def test_a_photo_further_outside_must_look_better_by_as_much() -> None:
    angles = np.arccos([0.9, 0.8, 0.2])
    rows = np.column_stack([np.cos(angles), np.sin(angles)]).astype(np.float32)
    index = {"a": GlobalRows(rows)}
    query = {"a": np.array([1.0, 0.0], dtype=np.float32)}
    # (0.9 - 0.2) * 0.8 = 0.56 and (0.8 - 0.2) * 1 = 0.6.
    assert retrieve(query, index, 3, np.array([0.8, 1.0, 1.0])).images.tolist() == [1, 0, 2]
    assert retrieve(query, index, 3, np.array([0.9, 1.0, 1.0])).images.tolist() == [0, 1, 2]
