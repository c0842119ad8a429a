from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from visloc.archive import Map, MapStore, open_map
from visloc.retrieval.inverted import width_of
from visloc_extensions.sets.coarse_model import learn, random_rotation


@pytest.fixture(scope="module")
def room(built_maps: Path) -> Map:
    return MapStore(built_maps).open("room")


def test_a_rotation_keeps_cosines() -> None:
    for dim in (1, 63, 64, 65):
        rotation = random_rotation(dim, np.random.default_rng(0))
        assert rotation.shape == (dim, width_of(dim))
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(dim), atol=1e-6)


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

    assert once.keys() == {"vocabulary", "mean", "axes", "rotation"}
    for name, array in once.items():
        np.testing.assert_array_equal(array, again[name])
    dim = once["axes"].shape[1]
    assert once["rotation"].shape == (dim, width_of(dim))
