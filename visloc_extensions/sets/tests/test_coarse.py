from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from uuid import uuid4

import numpy as np
import pytest
from numpy.typing import NDArray

from visloc.archive import Map, MapStore, SetOutline
from visloc.archive.index_files import check_lists
from visloc.errors import Conflict, MapCorrupt
from visloc.features import make_local_features
from visloc.kapture import read_dataset
from visloc.photos.reading import read_photo_file
from visloc.retrieval.inverted import MadeLists
from visloc.types import LocalFeatures
from visloc_extensions.sets.coarse import (
    CoarseModel,
    check_descriptor,
    coarse_index,
    described,
    descriptors_of,
    rank_tiles,
    ranked,
    score_without,
)
from visloc_extensions.sets.coarse_model import learn, random_rotation
from visloc_extensions.sets.files import CoarseIndex, MapSet

DIM = 64
MODEL = {"rotation": random_rotation(DIM, np.random.default_rng(11))}


def unit(rows: NDArray[np.float64]) -> NDArray[np.float32]:
    return (rows / np.linalg.norm(rows, axis=-1, keepdims=True)).astype(np.float32)


def tile_of(rows: NDArray[np.float32]) -> MadeLists:
    return described(rows, MODEL)


def joined(tiles: Sequence[MadeLists], folder: Path, model: CoarseModel) -> CoarseIndex:
    return coarse_index(iter(tiles), model, folder / f"lists-{uuid4()}")


def index_of(
    folder: Path, num_tiles: int, photos: int, seed: int = 0
) -> tuple[CoarseIndex, NDArray[np.float32]]:
    """Tiles whose photos look like each other, and those photos' descriptors (T, n, D)."""
    random = np.random.default_rng(seed)
    middles = unit(random.normal(size=(num_tiles, 1, DIM)))
    rows = unit(middles + 0.08 * random.normal(size=(num_tiles, photos, DIM)))
    return joined([tile_of(some) for some in rows], folder, MODEL), rows


@pytest.mark.parametrize("num_tiles", [7, 60, 1000])  # of the last, a tenth of the lists
def test_a_photo_like_those_of_a_tile_finds_it(tmp_path: Path, num_tiles: int) -> None:
    index, rows = index_of(tmp_path, num_tiles, 5)

    for tile in range(0, num_tiles, max(1, num_tiles // 10)):
        best = ranked(index, unit(rows[tile, 2] + 0.02 * rows[tile, 1]))
        assert best[0].tile == tile
        assert best[0].score > 0.7 > best[1].score + 0.1
    assert len(best) == min(num_tiles, 50)
    assert [s.score for s in best] == sorted((s.score for s in best), reverse=True)


def test_scores_are_the_mean_cosines_of_the_three_best_photos(tmp_path: Path) -> None:
    index, rows = index_of(tmp_path, 3, 6)
    query = rows[1, 0]

    found = {s.tile: s.score for s in ranked(index, query)}

    cosines = rows[1, 0] @ rows.reshape(-1, DIM).T
    for tile in range(3):
        best = np.sort(cosines[6 * tile : 6 * tile + 6])[-3:]
        assert found[tile] == pytest.approx(best.mean(), abs=0.2)
    assert found[1] > 0.75


def test_photos_that_are_left_out_do_not_count(tmp_path: Path) -> None:
    index, rows = index_of(tmp_path, 3, 6)
    query = rows[1, 0]
    whole = {s.tile: s.score for s in ranked(index, query)}[1]

    without = score_without(index, query, 1, np.array([0, 2, 3]))

    cosines = np.sort(rows[1, [1, 4, 5]] @ query)
    assert without == pytest.approx(cosines.mean(), abs=0.2)
    assert without < whole
    assert score_without(index, query, 1, np.arange(6)) == -1.0


def test_codes_tell_enough_to_leave_out_the_other_tiles(tmp_path: Path) -> None:
    index, rows = index_of(tmp_path, 300, 6)
    random = np.random.default_rng(7)

    right = 0
    for tile in random.integers(0, 300, 50).tolist():
        noise = unit(random.normal(size=DIM))
        best = ranked(index, unit(0.6 * rows[tile, 0] + 0.8 * noise))
        right += best[0].tile == tile
    assert right >= 45


@pytest.mark.parametrize("num_allowed", [3, 200])
def test_only_allowed_tiles_are_ranked(tmp_path: Path, num_allowed: int) -> None:
    index, rows = index_of(tmp_path, 400, 4)
    allowed = np.zeros(400, np.bool_)
    allowed[np.linspace(1, 399, num_allowed).astype(int)] = True
    tile = int(np.flatnonzero(allowed)[1])

    best = ranked(index, rows[tile, 0], allowed)

    assert all(allowed[s.tile] for s in best)
    assert len(best) == min(num_allowed, 50)
    assert best[0].tile == tile
    assert tile + 1 not in {s.tile for s in ranked(index, rows[tile + 1, 0], allowed)}


def test_a_tile_of_two_photos_counts_as_one_of_many(tmp_path: Path) -> None:
    _, rows = index_of(tmp_path, 2, 10)
    small = joined([tile_of(rows[0, 8:]), tile_of(rows[1])], tmp_path, MODEL)

    assert small.inverted.sizes.reshape(2, -1).sum(axis=1).tolist() == [2, 10]
    assert ranked(small, rows[0, 9])[0].tile == 0


def test_tiles_join_in_their_order(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    rows = [unit(random.normal(size=(n, DIM))) for n in (3, 1, 5)]

    index = joined([tile_of(some) for some in rows], tmp_path, MODEL)

    assert index.offsets.tolist() == [0, 3, 4, 9]
    check_lists(index.inverted)
    for tile, some in enumerate(rows):
        assert score_without(index, some[0], tile, np.empty(0, np.int64)) > 0.2
    photos, cosines = index.inverted.rough_cosines(rows[1][0] @ MODEL["rotation"], np.arange(12))
    assert photos[cosines.argmax()] == 3


# With the map of the sample


@pytest.fixture(scope="module")
def room(built_maps: Path) -> Map:
    return MapStore(built_maps).open("room")


@pytest.fixture(scope="module")
def rooms(
    room: Map, outline: Callable[..., SetOutline], tmp_path_factory: pytest.TempPathFactory
) -> MapSet:
    """The room as one tile, and as another one of photos that see what nobody has seen."""
    model, random = dict(learn(lambda _: room, 1)), np.random.default_rng(3)
    # Without whitening, which takes away what the photos of the only room have in common.
    # As many dimensions as sets have: codes of fewer tell less.
    model["axes"] = random.normal(size=(len(model["mean"]), 256)).astype(np.float32)
    model["mean"] = np.zeros_like(model["mean"])
    model["rotation"] = random_rotation(256, random)
    other = described(unit(random.normal(size=(9, 256))), model)
    said = outline([((0, 0, 0), (1, 1, 1))] * 2)
    index = joined(
        [other, described(descriptors_of(room, model), model)],
        tmp_path_factory.mktemp("rooms"),
        model,
    )
    return MapSet(said.manifest, said.photo_boxes, said.reaches, Path(), index)


def test_photos_of_the_room_find_it(rooms: MapSet, sample: Path) -> None:
    extractor = make_local_features("sift")
    queries = read_dataset(sample / "query")
    for record in queries.images:
        photo = read_photo_file(queries.path_of(record))
        best = rank_tiles(rooms, extractor.extract(photo.rgb, max_keypoints=2000))
        assert best[0].tile == 1
        assert best[0].score > best[1].score + 0.03


def test_a_photo_of_nothing_is_like_no_tile(rooms: MapSet) -> None:
    nothing = LocalFeatures(
        np.zeros((0, 2), np.float32),
        np.zeros((0, 128), np.float32),
        np.zeros(0, np.float32),
        np.zeros(0, np.float32),
    )

    assert all(abs(s.score) < 0.5 for s in rank_tiles(rooms, nothing))


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
        coarse.offsets,
        coarse.inverted,
    )

    with pytest.raises(Conflict) as caught:
        check_descriptor(MapSet(rooms.manifest, rooms.photo_boxes, rooms.reaches, Path(), old))
    assert caught.value.code == "map.features"
