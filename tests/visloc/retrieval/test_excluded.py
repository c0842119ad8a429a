"""Photos that priors exclude although they look as much like the query as allowed ones."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from visloc.options import Fusion
from visloc.retrieval.excluded import excluded_photos
from visloc.retrieval.fusion import LateFusion
from visloc.retrieval.index import retrieve
from visloc.retrieval.rows import GlobalRows

NUM, DIM = 60, 6


def units(rng: np.random.Generator, *shape: int) -> NDArray[np.float32]:
    vectors = rng.normal(size=shape)
    return (vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)).astype(np.float32)


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

    scores = fusion.scores({name: rows.cosines(query[name]) for name, rows in index.items()})
    best_allowed = np.sort(scores[weights > 0])[::-1][:5]
    excluded = np.flatnonzero(weights == 0)
    best_excluded = excluded[np.argsort(-scores[excluded], kind="stable")][:5]
    expected = best_excluded[scores[best_excluded] > best_allowed.min(initial=np.inf)]
    assert found.tolist() == expected.tolist()


def test_nothing_is_excluded_without_priors_or_where_all_or_none_are_allowed() -> None:
    rng = np.random.default_rng(0)
    index, query = {"a": GlobalRows(units(rng, NUM, DIM))}, {"a": units(rng, DIM)}
    fusion = LateFusion()
    found = retrieve(query, index, 20, None, fusion)
    assert len(excluded_photos(query, index, found, None, fusion)) == 0
    assert len(excluded_photos(query, index, found, np.ones(NUM), fusion)) == 0
    none = retrieve(query, index, 20, np.zeros(NUM), fusion)
    assert len(excluded_photos(query, index, none, np.zeros(NUM), fusion)) == 0
