"""Maps of so many photos that not all are compared with a query."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

import visloc.retrieval.index as retrieval
from visloc.retrieval.index import retrieve
from visloc.retrieval.rows import GlobalRows, in_8_bits
from visloc.retrieval.shortlist import make_clusters

PLACES, PHOTOS, DIM = 40, 25, 32


def unit(rows: NDArray[np.floating]) -> NDArray[np.float32]:
    return np.asarray(rows / np.linalg.norm(rows, axis=-1, keepdims=True), np.float32)


def rows_of_places(seed: int) -> NDArray[np.float32]:
    """Photos of places, in no order that tells which."""
    rng = np.random.default_rng(seed)
    centers = unit(rng.normal(size=(PLACES, 1, DIM)))
    spread = 0.5 * unit(rng.normal(size=(PLACES, PHOTOS, DIM)))
    return unit((centers + spread).reshape(-1, DIM))


@pytest.fixture(scope="module")
def index() -> dict[str, GlobalRows]:
    made = {}
    order = np.random.default_rng(9).permutation(PLACES * PHOTOS)
    for seed, name in enumerate(("a", "b")):
        rows = rows_of_places(seed)[order]
        made[name] = GlobalRows(*in_8_bits(rows), make_clusters(rows))
    return made


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Look at a tenth of the photos."""
    monkeypatch.setattr(retrieval, "MAX_EXACT", 50)
    monkeypatch.setattr(retrieval, "_NUM_PROPOSED", 100)
    monkeypatch.setattr(retrieval, "_PROPOSED_PER_RESULT", 1)


def all_compared(index: dict[str, GlobalRows]) -> dict[str, GlobalRows]:
    return {name: GlobalRows(rows.values, rows.scales) for name, rows in index.items()}


def query_like(index: dict[str, GlobalRows], photo: int, seed: int) -> dict[str, NDArray]:
    rng = np.random.default_rng(seed)
    return {name: unit(rows[photo] + 0.1 * rng.normal(size=DIM)) for name, rows in index.items()}


def test_every_photo_is_in_one_cluster_with_those_like_it(index: dict[str, GlobalRows]) -> None:
    for rows in index.values():
        clusters = rows.clusters
        assert clusters is not None
        assert np.array_equal(np.sort(clusters.members), np.arange(len(rows)))
        nearest = (rows[:] @ clusters.centers.T).argmax(axis=1)
        told = np.empty(len(rows), np.int64)
        for cluster, (start, stop) in enumerate(
            zip(clusters.offsets, clusters.offsets[1:], strict=False)
        ):
            told[clusters.members[start:stop]] = cluster
        assert (told == nearest).mean() > 0.99  # 8 bits move a row across a border now and then


def test_equal_rows_make_equal_clusters() -> None:
    rows = rows_of_places(3)
    a, b = make_clusters(rows), make_clusters(rows.copy())
    assert np.array_equal(a.centers, b.centers)
    assert np.array_equal(a.members, b.members)


def test_fewer_rows_than_clusters_and_rows_that_are_all_the_same_make_clusters() -> None:
    for rows in (np.eye(2, 3, dtype=np.float32), np.ones((9, 1), np.float32)):
        clusters = make_clusters(rows)
        assert np.array_equal(np.sort(clusters.members), np.arange(len(rows)))
        assert np.isfinite(clusters.centers).all()


@pytest.mark.usefixtures("few")
def test_the_best_of_all_photos_are_found_among_few(index: dict[str, GlobalRows]) -> None:
    found = 0
    for photo in range(0, 1000, 20):
        query = query_like(index, photo, photo)
        best, some = retrieve(query, all_compared(index), 10), retrieve(query, index, 10)
        assert some.images[0] == best.images[0]
        found += len(np.intersect1d(best.images, some.images))
        # What is found has the score that it has among all.
        scores = dict(zip(best.images.tolist(), best.scores.tolist(), strict=True))
        for image, score in zip(some.images.tolist(), some.scores.tolist(), strict=True):
            assert score == pytest.approx(scores.get(image, score), abs=1e-6)
    assert found / 500 > 0.95


@pytest.mark.usefixtures("few")
@pytest.mark.parametrize("num_allowed", [30, 400])  # compared all, and by clusters
def test_excluded_photos_never_come_and_there_are_as_many_as_wanted(
    index: dict[str, GlobalRows], num_allowed: int
) -> None:
    rng = np.random.default_rng(0)
    for photo in range(0, 1000, 100):
        weights = np.zeros(1000)
        weights[rng.choice(1000, num_allowed, replace=False)] = rng.uniform(0.1, 1, num_allowed)
        query = query_like(index, photo, photo)
        found = retrieve(query, index, 20, weights)
        assert (weights[found.images] > 0).all()
        assert len(np.unique(found.images)) == 20
        # With equal weights, those that exclude nothing but what is excluded anyway.
        allowed = (weights > 0).astype(np.float64)
        best = retrieve(query, all_compared(index), 20, allowed).images
        some = retrieve(query, index, 20, allowed).images
        assert some[0] == best[0]


@pytest.mark.usefixtures("few")
def test_all_may_be_asked_for_and_none_allowed(index: dict[str, GlobalRows]) -> None:
    query = query_like(index, 0, 0)
    assert len(retrieve(query, index, 5000).images) == 1000
    assert len(retrieve(query, index, 20, np.zeros(1000)).images) == 0


@pytest.mark.usefixtures("few")
def test_a_blank_query_gives_photos_that_are_similar_to_nothing(
    index: dict[str, GlobalRows],
) -> None:
    blank = {name: np.zeros(DIM, np.float32) for name in index}
    assert retrieve(blank, index, 5).scores.tolist() == [0.0] * 5


def test_8_bits_keep_directions_and_zeros() -> None:
    rng = np.random.default_rng(0)
    rows = unit(rng.normal(size=(50, 64)) * rng.uniform(0.1, 1, 64))
    rows[7] = 0
    stored = GlobalRows(*in_8_bits(rows))
    back = stored[:]
    lengths = np.linalg.norm(back, axis=1)
    assert lengths[7] == 0
    assert np.delete(lengths, 7) == pytest.approx(1.0, abs=1e-6)
    assert (np.delete((back * rows).sum(axis=1), 7) > 0.9999).all()
    query = unit(rng.normal(size=64))
    np.testing.assert_allclose(stored.cosines(query), back @ query, atol=1e-6)
    some = np.array([30, 2, 7])
    np.testing.assert_allclose(stored.cosines(query, some), back[some] @ query, atol=1e-6)
    assert np.array_equal(stored[3], back[3])
