"""Photos that priors exclude although they look as much like the query as allowed ones."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from visloc.options import Fusion
from visloc.retrieval.fusion import LateFusion
from visloc.retrieval.index import GlobalRows, Retrieved, compare, excluded_photos, retrieve

NUM, DIM = 60, 6


def units(rng: np.random.Generator, *shape: int) -> NDArray[np.float32]:
    vectors = rng.normal(size=shape)
    return (vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)).astype(np.float32)


def scores_of(
    query: dict[str, NDArray[np.float32]], index: dict[str, GlobalRows], fusion: LateFusion
) -> NDArray[np.float64]:
    return fusion.scores({name: rows.cosines(query[name]) for name, rows in index.items()})


def expected(
    query: dict[str, NDArray[np.float32]],
    index: dict[str, GlobalRows],
    weights: NDArray[np.float64],
    fusion: LateFusion,
    best_allowed: NDArray[np.float64],
) -> list[int]:
    """Return the five best excluded photos, as far as they are better than the fifth allowed."""
    scores, excluded = scores_of(query, index, fusion), np.flatnonzero(weights == 0)
    best = excluded[np.argsort(-scores[excluded], kind="stable")][:5]
    return [int(photo) for photo in best if scores[photo] > best_allowed.min(initial=np.inf)]


@pytest.mark.parametrize("operator", [Fusion.GHARM, Fusion.MEAN, Fusion.MIN])
@pytest.mark.parametrize("seed", range(20))
def test_photos_count_if_they_are_better_than_the_fifth_that_is_allowed(
    operator: Fusion, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    index = {name: GlobalRows(units(rng, NUM, DIM)) for name in ("a", "b")}
    query = {name: units(rng, DIM) for name in index}
    weights = (rng.uniform(size=NUM) < rng.choice([0.05, 0.3, 0.8])).astype(np.float64)
    fusion = LateFusion(operator)

    allowed = retrieve(query, index, 20, weights, fusion)
    found = excluded_photos(query, index, allowed, weights, fusion)

    best_allowed = np.sort(scores_of(query, index, fusion)[weights > 0])[::-1][:5]
    assert found.tolist() == expected(query, index, weights, fusion, best_allowed)


@pytest.mark.parametrize("chosen", [False, True])
@pytest.mark.parametrize("seed", range(20))
def test_allowed_photos_that_are_not_compared_hide_no_excluded_ones(
    seed: int, *, chosen: bool
) -> None:
    """Photos at the edge of a prior hardly count, and a caller who names photos leaves some out."""
    rng = np.random.default_rng(seed)
    index = {name: GlobalRows(units(rng, NUM, DIM)) for name in ("a", "b")}
    query, fusion = {name: units(rng, DIM) for name in index}, LateFusion()
    scores = scores_of(query, index, fusion)
    weights = np.where(rng.uniform(size=NUM) < 0.2, 0.0, 1.0 if chosen else 0.01)
    weights[np.argsort(scores)[: NUM // 2]] = 1.0
    retrieved: Retrieved = (
        compare(query, index, np.argsort(scores)[:10], weights, fusion)
        if chosen
        else retrieve(query, index, 10, weights, fusion)
    )

    found = excluded_photos(query, index, retrieved, weights, fusion)

    compared = np.sort(scores[retrieved.images])[::-1][:5]
    assert found.tolist() == expected(query, index, weights, fusion, compared)
    assert len(found) == min(5, np.count_nonzero(weights == 0))


def test_nothing_is_excluded_without_priors_or_where_all_or_none_are_allowed() -> None:
    rng = np.random.default_rng(0)
    index, query = {"a": GlobalRows(units(rng, NUM, DIM))}, {"a": units(rng, DIM)}
    fusion = LateFusion()
    found = retrieve(query, index, 20, None, fusion)
    assert len(excluded_photos(query, index, found, None, fusion)) == 0
    assert len(excluded_photos(query, index, found, np.ones(NUM), fusion)) == 0
    none = retrieve(query, index, 20, np.zeros(NUM), fusion)
    assert len(excluded_photos(query, index, none, np.zeros(NUM), fusion)) == 0
