"""Maps of so many photos that an inverted file proposes those that are compared with a query."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import visloc.retrieval.index as retrieval
from tests.visloc.retrieval.made_lists import inverted
from visloc.archive.index_files import check_lists, sizes_fit
from visloc.errors import MapCorrupt
from visloc.retrieval.index import GlobalRows, in_8_bits, retrieve
from visloc.retrieval.inverted import (
    InvertedFile,
    bytes_of,
    make_centers,
    make_lists,
    row_bytes,
    width_of,
)

PLACES, PHOTOS, DIM = 40, 25, 96
NUM = PLACES * PHOTOS


def unit(rows: NDArray[np.floating]) -> NDArray[np.float32]:
    return np.asarray(rows / np.linalg.norm(rows, axis=-1, keepdims=True), np.float32)


def rows_of_places(seed: int) -> NDArray[np.float32]:
    """Photos of places, in no order that tells which."""
    rng = np.random.default_rng(seed)
    centers = unit(rng.normal(size=(PLACES, 1, DIM)))
    spread = 0.5 * unit(rng.normal(size=(PLACES, PHOTOS, DIM)))
    return unit((centers + spread).reshape(-1, DIM))


@pytest.fixture(scope="module")
def index(tmp_path_factory: pytest.TempPathFactory) -> dict[str, GlobalRows]:
    made = {}
    order = np.random.default_rng(9).permutation(NUM)
    for seed, name in enumerate(("a", "b")):
        rows = rows_of_places(seed)[order]
        path = tmp_path_factory.mktemp("index") / "lists"
        made[name] = GlobalRows(*in_8_bits(rows), inverted(rows, path))
    return made


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Look at a tenth of the photos."""
    monkeypatch.setattr(retrieval, "_MAX_ALLOWED_EXACT", 50)
    monkeypatch.setattr(retrieval, "_MAX_DOUBTFUL", 0)
    monkeypatch.setattr(retrieval, "_MIN_PROPOSED", 60)
    monkeypatch.setattr(retrieval, "_LISTS", 12)
    monkeypatch.setattr(retrieval, "_PROPOSED_PER_RESULT", 1)


def all_compared(index: Mapping[str, GlobalRows]) -> dict[str, GlobalRows]:
    return {name: GlobalRows(rows.values, rows.scales) for name, rows in index.items()}


def query_like(index: Mapping[str, GlobalRows], photo: int, seed: int) -> dict[str, NDArray]:
    rng = np.random.default_rng(seed)
    noise = {name: unit(rng.normal(size=DIM)) for name in index}
    return {name: unit(rows[photo] + 0.5 * noise[name]) for name, rows in index.items()}


def unlike(index: Mapping[str, GlobalRows], seed: int) -> dict[str, NDArray]:
    """A query that looks like nothing in the map."""
    rng = np.random.default_rng(seed)
    return {name: unit(rng.normal(size=DIM)) for name in index}


def test_every_row_is_in_the_list_of_the_nearest_centre() -> None:
    rows = rows_of_places(0)
    centers = make_centers(rows, 30)
    lists = make_lists(rows, centers)
    assert centers.shape == (30, width_of(DIM))
    assert not centers[:, DIM:].any()
    assert np.array_equal(np.sort(lists.ids), np.arange(NUM))
    assert (np.linalg.norm(centers, axis=1) < 1).all()
    nearest = (rows @ unit(centers)[:, :DIM].T).argmax(axis=1)
    assert np.array_equal(nearest[lists.ids], np.repeat(np.arange(30), lists.sizes))


def test_equal_rows_make_equal_lists() -> None:
    rows = rows_of_places(3)
    a, b = make_centers(rows, 20), make_centers(rows.copy(), 20)
    assert np.array_equal(a, b)
    assert list(bytes_of([make_lists(rows, a)])) == list(bytes_of([make_lists(rows, b)]))


def test_fewer_rows_than_lists_and_rows_that_are_all_the_same_make_lists() -> None:
    for rows in (np.eye(2, 3, dtype=np.float32), np.ones((9, 1), np.float32)):
        centers = make_centers(rows, 5)
        assert np.isfinite(centers).all()
        assert sorted(make_lists(rows, centers).ids) == list(range(len(rows)))


@pytest.mark.parametrize("dim", [1, 63, 64, 65, 200, 1024])
def test_errors_of_rough_cosines_have_the_deviation_that_is_stated(
    tmp_path: Path, dim: int
) -> None:
    rng = np.random.default_rng(dim)
    rows, queries = unit(rng.normal(size=(500, dim))), unit(rng.normal(size=(20, dim)))
    opened = inverted(rows, tmp_path / "lists")
    errors = []
    for query in queries:
        found, rough = opened.rough_cosines(query, np.arange(len(opened.sizes)))
        assert np.array_equal(np.sort(found), np.arange(500))
        errors.append(rough - rows[found] @ query)
    assert np.std(errors) == pytest.approx(opened.error / 2, rel=0.06, abs=1e-6)
    assert abs(np.mean(errors)) < 0.1 * opened.error + 1e-6
    # Of a normal distribution, 4.6 % are further away than two deviations.
    assert np.mean(np.abs(errors) > opened.error + 1e-6) < 0.065


def test_lists_near_a_query_are_those_of_the_largest_products(
    index: dict[str, GlobalRows],
) -> None:
    opened = index["a"].inverted
    assert opened is not None
    query = query_like(index, 7, 0)["a"]
    products = unit(opened.centers)[:, :DIM] @ query
    assert list(opened.nearest_lists(query, 5)) == list(np.argsort(-products)[:5])
    among = np.arange(10, 20)
    best = among[np.argsort(-products[among])[:3]]
    assert list(opened.nearest_lists(query, 3, among)) == list(best)


@pytest.mark.parametrize("count", [1, 3, 40, 1000])
def test_the_rows_most_alike_are_those_of_all_lists_however_few_are_searched_first(
    index: dict[str, GlobalRows], count: int
) -> None:
    opened = index["a"].inverted
    assert opened is not None
    rng = np.random.default_rng(count)
    for allowed in (None, rng.random(NUM) < 0.3):
        for photo in range(0, NUM, 40):
            query = query_like(index, photo, photo)["a"]
            lists = opened.nearest_lists(query, len(opened.sizes))
            _, rough = opened.rough_cosines(query, lists, allowed)
            found, cosines = opened.most_alike(query, lists, count, allowed)
            assert len(np.unique(found)) == len(found)
            assert allowed is None or allowed[found].all()
            assert np.array_equal(np.sort(cosines), np.sort(rough)[-count:])


@pytest.mark.usefixtures("few")
def test_the_best_of_all_photos_are_found_among_few(index: dict[str, GlobalRows]) -> None:
    found = 0
    for photo in range(0, NUM, 20):
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
@pytest.mark.parametrize("num_allowed", [30, 400])  # compared all, and proposed
def test_excluded_photos_never_come_and_there_are_as_many_as_wanted(
    index: dict[str, GlobalRows], num_allowed: int
) -> None:
    rng = np.random.default_rng(0)
    for photo in range(0, NUM, 100):
        weights = np.zeros(NUM)
        weights[rng.choice(NUM, num_allowed, replace=False)] = rng.uniform(0.1, 1, num_allowed)
        query = query_like(index, photo, photo)
        found = retrieve(query, index, 20, weights)
        assert (weights[found.images] > 0).all()
        assert len(np.unique(found.images)) == 20
        # With equal weights, those that exclude nothing but what is excluded anyway.
        allowed = (weights > 0).astype(np.float64)
        best = retrieve(query, all_compared(index), 20, allowed).images
        some = retrieve(query, index, 20, allowed).images
        assert some[0] == best[0]


def test_allowed_photos_that_look_like_nothing_are_all_compared(
    index: dict[str, GlobalRows], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(retrieval, "_MAX_ALLOWED_EXACT", 50)
    monkeypatch.setattr(retrieval, "_MIN_PROPOSED", 30)
    monkeypatch.setattr(retrieval, "_LISTS", 3)
    for photo in range(0, NUM, 100):
        query = query_like(index, photo, photo)
        near = index["a"][:] @ query["a"]
        allowed = (near < np.median(near)).astype(np.float64)  # nothing of its place
        best = retrieve(query, all_compared(index), 20, allowed)
        some = retrieve(query, index, 20, allowed)
        assert np.array_equal(some.images, best.images)
        np.testing.assert_allclose(some.scores, best.scores)


def test_codes_of_all_allowed_photos_propose_where_nothing_stands_out(
    index: dict[str, GlobalRows], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(retrieval, "_MAX_ALLOWED_EXACT", 50)
    monkeypatch.setattr(retrieval, "_MIN_PROPOSED", 30)
    monkeypatch.setattr(retrieval, "_LISTS", 3)
    monkeypatch.setattr(retrieval, "_DOUBTFUL_ROWS", 150)
    found = []
    for seed in range(20):
        query, allowed = unlike(index, seed), (np.arange(NUM) % 2).astype(np.float64)
        best = retrieve(query, all_compared(index), 10, allowed)
        some = retrieve(query, index, 10, allowed)
        assert allowed[some.images].all()
        found.append(len(np.intersect1d(best.images, some.images)) / 10)
    assert np.mean(found) > 0.9


def test_more_are_proposed_where_nothing_stands_out_among_very_many(
    index: dict[str, GlobalRows], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(retrieval, "_MAX_ALLOWED_EXACT", 50)
    monkeypatch.setattr(retrieval, "_MAX_DOUBTFUL", 100)
    monkeypatch.setattr(retrieval, "_MIN_PROPOSED", 15)
    monkeypatch.setattr(retrieval, "_PROPOSED_PER_RESULT", 1)
    monkeypatch.setattr(retrieval, "_LISTS", 12)

    def recall() -> float:
        found = []
        for seed in range(20):
            query, allowed = unlike(index, seed), (np.arange(NUM) % 2).astype(np.float64)
            best = retrieve(query, all_compared(index), 10, allowed)
            some = retrieve(query, index, 10, allowed)
            assert allowed[some.images].all()
            found.append(len(np.intersect1d(best.images, some.images)) / 10)
        return float(np.mean(found))

    assert recall() > 0.9
    monkeypatch.setattr(retrieval, "_WIDER_PROPOSED", 1)
    assert recall() < 0.7


def test_a_query_that_looks_like_nothing_is_compared_with_all(
    index: dict[str, GlobalRows], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(retrieval, "_MAX_ALLOWED_EXACT", 50)
    query = unlike(index, 0)
    best = retrieve(query, all_compared(index), 20)
    assert np.array_equal(retrieve(query, index, 20).images, best.images)


@pytest.mark.usefixtures("few")
def test_none_may_be_allowed(index: dict[str, GlobalRows]) -> None:
    query = query_like(index, 0, 0)
    assert len(retrieve(query, index, 20, np.zeros(NUM)).images) == 0


@pytest.mark.usefixtures("few")
def test_all_may_be_asked_for(index: dict[str, GlobalRows]) -> None:
    assert len(retrieve(query_like(index, 0, 0), index, 5000).images) == NUM


@pytest.mark.usefixtures("few")
def test_a_blank_query_gives_photos_that_are_similar_to_nothing(
    index: dict[str, GlobalRows],
) -> None:
    blank = {name: np.zeros(DIM, np.float32) for name in index}
    assert retrieve(blank, index, 5).scores.tolist() == [0.0] * 5


def hostile(kind: str, content: bytes, sizes: NDArray[np.int64]) -> bytes:
    bytes_of_row, start = row_bytes(width_of(DIM)), 0
    altered = bytearray(content)
    random = np.random.default_rng(0)
    for size in sizes.tolist():
        middle = start + size * (bytes_of_row - 8)
        stop = start + size * bytes_of_row
        if kind == "codes of ones":
            altered[start:middle] = b"\xff" * (middle - start)
        elif kind == "random codes":
            altered[start:middle] = random.bytes(middle - start)
        else:
            value = {"ids beyond": 2**62, "ids below": -(2**63), "ids of one": 7}[kind]
            altered[middle:stop] = np.full(size, value, "<i8").tobytes()
        start = stop
    return bytes(altered)


@pytest.mark.parametrize(
    "kind", ["codes of ones", "random codes", "ids beyond", "ids below", "ids of one"]
)
def test_hostile_lists_are_told_and_searched_without_harm(tmp_path: Path, kind: str) -> None:
    rows = rows_of_places(1)
    centers = make_centers(rows, 20)
    lists = make_lists(rows, centers)
    path = tmp_path / "lists"
    path.write_bytes(hostile(kind, b"".join(bytes_of([lists])), lists.sizes))
    opened = InvertedFile(centers, lists.sizes, path)
    # Random factors may be finite by chance: then only the checksum tells.
    if kind != "random codes":
        with pytest.raises(MapCorrupt):
            check_lists(opened)
    index = {"a": GlobalRows(*in_8_bits(rows), opened)}
    for allowed in (None, np.arange(NUM) % 2 == 0):
        found, _ = opened.rough_cosines(rows[5], np.arange(20), allowed)
        assert ((found >= 0) & (found < NUM)).all()
        assert allowed is None or allowed[found].all()
    weights = (np.arange(NUM) < 900).astype(np.float64)
    images = retrieve({"a": rows[5]}, index, 20, weights).images
    assert ((images >= 0) & (images < 900)).all()
    assert len(np.unique(images)) == len(images)


@pytest.mark.parametrize(
    ("sizes", "good"),
    [
        ([2, 0, 3], True),
        ([5], True),
        ([2, 2], False),
        ([6, -1], False),
        ([2**62, 2**62, 2**62, 2**62, 5], False),
        ([-(2**63), 2**63 - 1, 6], False),
    ],
)
def test_sizes_that_cannot_be_are_told(sizes: list[int], good: bool) -> None:
    assert sizes_fit(np.array(sizes, np.int64), 5) is good


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
