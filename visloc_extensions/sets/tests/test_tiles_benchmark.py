"""Generated tiles: as alike as real ones, and through the real index from end to end."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.generated_tiles import (
    LEVELS,
    PASSES,
    SIMILARITIES,
    City,
    generated_model,
    similarities,
)
from benchmarks.tiles import BLOCK_TILES, answers, make_set, write_queries
from benchmarks.tiles_queries import WARM_UP
from visloc_extensions.sets.coarse import MAX_RANKED
from visloc_extensions.sets.files import verify_set

MODEL = generated_model(len(City(1, PASSES).stds["within"]), words=2, word_dim=8)


def test_generated_photos_are_as_alike_as_real_ones() -> None:
    real = json.loads(SIMILARITIES.read_text())["quantiles"]
    made = similarities(City(10_000, 1000), range(0, 10_000, 241), MODEL, queries=8)
    assert made.keys() == real.keys()
    # What is rarer than 1 % needs more tiles than a test has time for; photos apart are less alike
    # in the passes of look-alikes.
    for name, least in (("nearest", 0.1), ("co-visible", 0.1), ("elsewhere", 0.1), ("apart", 0.5)):
        some = slice(LEVELS.index(least), LEVELS.index(0.99) + 1)
        off = np.array(made[name][some]) - np.array(real[name][some])
        assert np.abs(off).max() < 0.1, (name, off)
    # Four rows stand for 1000 photos, of eight passes, less well than for the 60 of a map.
    assert made["own centroids"][2] <= real["own centroids"][2]


def test_a_tile_is_the_same_whenever_it_is_made() -> None:
    city = City(64, 40, seed=3)
    one, again = city.tile(17, 2), City(64, 40, seed=3).tile(17, 2)
    np.testing.assert_array_equal(one.rows, again.rows)
    np.testing.assert_array_equal(one.queries, again.queries)
    assert not np.array_equal(one.rows, City(64, 40, seed=4).tile(17).rows)
    np.testing.assert_allclose(np.linalg.norm(one.rows, axis=1), 1.0, atol=1e-5)
    assert city.neighbourhood(17) == city.neighbourhood(26) != city.neighbourhood(20)


def test_queries_find_their_tiles_through_the_index(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    city = City(BLOCK_TILES + 14, 40)
    whole = make_set(tmp_path / "whole", city, MODEL)
    assert verify_set(whole).coarse.inverted.num_rows == city.num_tiles * 40

    # Stopped in the second block, and gone on with: the same index, and the first is not made anew.
    made: list[int] = []
    tile = City.tile

    def stops(self: City, number: int, num_queries: int = 0) -> object:
        made.append(number)
        if len(made) == BLOCK_TILES + 3:
            raise KeyboardInterrupt
        return tile(self, number, num_queries)

    monkeypatch.setattr(City, "tile", stops)
    with pytest.raises(KeyboardInterrupt):
        make_set(tmp_path / "stopped", city, MODEL)
    assert not (tmp_path / "stopped" / "set").exists()
    made.clear()
    again = make_set(tmp_path / "stopped", city, MODEL)
    assert made == list(range(BLOCK_TILES, city.num_tiles))
    files = sorted(path.relative_to(whole) for path in whole.rglob("*") if path.is_file())
    assert all((again / name).read_bytes() == (whole / name).read_bytes() for name in files)
    monkeypatch.undo()

    found = answers(whole, write_queries(tmp_path / "queries.npz", city, 20 + WARM_UP))
    assert found["photos"] == city.num_tiles * 40
    far, near = found["without a prior"], found["position to 30 m"]
    assert far["allowed"] == city.num_tiles
    assert far["ranked"] == MAX_RANKED < city.num_tiles
    assert 9 <= near["allowed"] < city.num_tiles
    assert far["first_5"] >= 0.8
    assert near["first_5"] >= far["first_5"]
    assert near["anywhere"] == 1.0
