from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from visloc.archive import CoarseIndex, FingerprintRecord, Map, MapStore, SetOutline, open_map
from visloc.archive.sets import MapSet
from visloc.errors import Conflict, MapCorrupt
from visloc.features import make_local_features
from visloc.images import read_photo_file
from visloc.kapture import read_dataset
from visloc.retrieval.rows import GlobalRows, in_8_bits
from visloc.sets.coarse import (
    BITS,
    DescribedTile,
    check_descriptor,
    coarse_index,
    codes_of,
    describe,
    learn,
    rank_tiles,
    ranked,
    score_without,
)
from visloc.types import LocalFeatures

DIM = 64


def unit(rows: NDArray[np.float64]) -> NDArray[np.float32]:
    return (rows / np.linalg.norm(rows, axis=-1, keepdims=True)).astype(np.float32)


def index_of(num_tiles: int, photos: int, seed: int = 0) -> tuple[CoarseIndex, NDArray[np.float32]]:
    """Tiles whose photos look like each other, and those photos' descriptors (T, n, D)."""
    random = np.random.default_rng(seed)
    middles = unit(random.normal(size=(num_tiles, 1, DIM)))
    rows = unit(middles + 0.08 * random.normal(size=(num_tiles, photos, DIM)))
    planes = random.normal(size=(DIM, BITS)).astype(np.float32)
    index = CoarseIndex(
        fingerprint=FingerprintRecord(name="localvlad", revision=1, parameters={}),
        model={"planes": planes},
        codes=codes_of(rows.reshape(-1, DIM), planes),
        offsets=np.arange(num_tiles + 1) * photos,
        centroids=GlobalRows(*in_8_bits(middles[:, 0])),
    )
    return index, rows


def test_codes_tell_angles() -> None:
    random = np.random.default_rng(1)
    planes = random.normal(size=(DIM, 4096)).astype(np.float32)
    a = random.normal(size=DIM)
    for angle in (0.0, 0.4, 1.2, np.pi / 2, 3.0):
        b = random.normal(size=DIM)
        b -= (a @ b) / (a @ a) * a
        rows = unit(np.array([a, np.cos(angle) * a / np.linalg.norm(a) + np.sin(angle) * unit(b)]))
        codes = codes_of(rows, planes)
        differing = int(np.bitwise_count(codes[0] ^ codes[1]).sum())
        # Four standard deviations of so many coins.
        assert abs(np.pi * differing / 4096 - angle) < 4 * np.pi * 0.5 / 64


@pytest.mark.parametrize("num_tiles", [7, 200, 1000])  # of the last, 400 are looked at
def test_a_photo_like_those_of_a_tile_finds_it(num_tiles: int) -> None:
    index, rows = index_of(num_tiles, 5)

    for tile in range(0, num_tiles, max(1, num_tiles // 10)):
        best = ranked(index, unit(rows[tile, 2] + 0.02 * rows[tile, 1]))
        assert best[0].tile == tile
        assert best[0].score > 0.7 > best[1].score + 0.1
    assert len(best) == min(num_tiles, 50)
    assert [s.score for s in best] == sorted((s.score for s in best), reverse=True)


def test_scores_are_the_mean_cosines_of_the_three_best_photos() -> None:
    index, rows = index_of(3, 6)
    query = rows[1, 0]

    found = {s.tile: s.score for s in ranked(index, query)}

    cosines = rows[1, 0] @ rows.reshape(-1, DIM).T
    for tile in range(3):
        best = np.sort(cosines[6 * tile : 6 * tile + 6])[-3:]
        # Three standard deviations of what 256 signs tell of a cosine.
        assert found[tile] == pytest.approx(best.mean(), abs=0.2)
    assert found[1] > 0.75


def test_photos_that_are_left_out_do_not_count() -> None:
    index, rows = index_of(3, 6)
    kept, query = np.array([1, 4, 5]), rows[1, 0]
    fewer = replace(
        index,
        codes=np.concatenate([index.codes[:6], index.codes[6 + kept], index.codes[12:]]),
        offsets=np.array([0, 6, 9, 15]),
    )

    without = score_without(index, query, 1, np.array([0, 2, 3]))

    assert without == {s.tile: s.score for s in ranked(fewer, query)}[1]
    assert without < {s.tile: s.score for s in ranked(index, query)}[1]


def test_codes_tell_enough_to_leave_out_the_other_tiles() -> None:
    index, rows = index_of(300, 6)
    random = np.random.default_rng(7)

    right = 0
    for tile in random.integers(0, 300, 50).tolist():
        noise = unit(random.normal(size=DIM))
        best = ranked(index, unit(0.6 * rows[tile, 0] + 0.8 * noise))
        right += best[0].tile == tile
    assert right >= 45


def test_only_allowed_tiles_are_ranked() -> None:
    index, rows = index_of(1000, 4)
    allowed = np.zeros(1000, np.bool_)
    allowed[[3, 500, 999]] = True

    best = ranked(index, rows[500, 0], allowed)

    assert {s.tile for s in best} == {3, 500, 999}
    assert best[0].tile == 500


def test_a_tile_of_two_photos_counts_as_one_of_many() -> None:
    index, rows = index_of(2, 10)
    small = CoarseIndex(
        index.fingerprint, index.model, index.codes[8:], np.array([0, 2, 12]), index.centroids
    )

    assert ranked(small, rows[0, 9])[0].tile == 0


def test_tiles_join_in_their_order() -> None:
    random = np.random.default_rng(0)
    tiles = [
        DescribedTile(
            random.integers(0, 2**63, (n, BITS // 64), np.uint64),
            unit(random.normal(size=(4, DIM))),
        )
        for n in (3, 1, 5)
    ]

    index = coarse_index(iter(tiles), {"planes": np.zeros((DIM, BITS), np.float32)})

    assert index.offsets.tolist() == [0, 3, 4, 9]
    np.testing.assert_array_equal(index.codes[3:4], tiles[1].codes)
    np.testing.assert_allclose(index.centroids[8:12], tiles[2].centroids, atol=0.01)


# With the map of the sample


@pytest.fixture(scope="module")
def room(built_maps: Path) -> Map:
    return MapStore(built_maps).open("room")


@pytest.fixture(scope="module")
def rooms(room: Map, outline: Callable[..., SetOutline]) -> MapSet:
    """The room as one tile, and as another one of photos that see what nobody has seen."""
    model = learn(lambda _: room, 1)
    random = np.random.default_rng(3)
    other = DescribedTile(
        random.integers(0, 2**63, (9, BITS // 64), np.uint64),
        unit(random.normal(size=(4, model["axes"].shape[1]))),
    )
    said = outline([((0, 0, 0), (1, 1, 1))] * 2)
    index = coarse_index(iter([other, describe(room, model)]), model)
    return MapSet(said.manifest, said.photo_boxes, said.reaches, Path(), index)


def test_photos_of_the_room_find_it(rooms: MapSet, sample: Path) -> None:
    extractor = make_local_features("sift")
    queries = read_dataset(sample / "query")
    for record in queries.images:
        photo = read_photo_file(queries.path_of(record))
        best = rank_tiles(rooms, extractor.extract(photo.rgb, max_keypoints=2000))
        assert best[0].tile == 1
        assert best[0].score > best[1].score + 0.2


def test_a_photo_of_nothing_is_like_no_tile(rooms: MapSet) -> None:
    nothing = LocalFeatures(
        np.zeros((0, 2), np.float32),
        np.zeros((0, 128), np.float32),
        np.zeros(0, np.float32),
        np.zeros(0, np.float32),
    )

    assert all(abs(s.score) < 0.5 for s in rank_tiles(rooms, nothing))


def test_many_tiles_teach_with_one_open_at_a_time(room: Map) -> None:
    files = Path("/proc/self/fd")
    before, most = len(list(files.iterdir())), 0

    def open_tile(_: int) -> Map:
        nonlocal most
        opened = open_map(room.path)
        most = max(most, len(list(files.iterdir())) - before)
        return opened

    alone = open_tile(0)
    assert most > 0
    of_one = 2 * most  # the one that is opened, and the one before it
    del alone
    learn(open_tile, 30)
    assert most <= of_one


def test_equal_seeds_learn_the_same(room: Map) -> None:
    once, again = (learn(lambda _: room, 1) for _ in range(2))

    assert once.keys() == {"vocabulary", "mean", "axes", "planes"}
    for name, array in once.items():
        np.testing.assert_array_equal(array, again[name])
    assert once["planes"].shape == (once["axes"].shape[1], BITS)


def test_a_vocabulary_of_other_features_is_named(rooms: MapSet) -> None:
    other = LocalFeatures(
        np.zeros((5, 2), np.float32),
        np.ones((5, 64), np.float32) / 8,
        np.zeros(5, np.float32),
        np.zeros(5, np.float32),
    )

    with pytest.raises(MapCorrupt, match="does not fit its local features"):
        rank_tiles(rooms, other)


def test_the_index_of_another_revision_is_refused(rooms: MapSet) -> None:
    check_descriptor(rooms)
    coarse = rooms.coarse
    old = CoarseIndex(
        coarse.fingerprint.model_copy(update={"revision": 0}),
        coarse.model,
        coarse.codes,
        coarse.offsets,
        coarse.centroids,
    )

    with pytest.raises(Conflict) as caught:
        check_descriptor(MapSet(rooms.manifest, rooms.photo_boxes, rooms.reaches, Path(), old))
    assert caught.value.code == "map.features"
