from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from visloc.archive import Map, MapStore
from visloc_extensions.sets.coarse import coarse_index, described, descriptors_of
from visloc_extensions.sets.coarse_model import learn
from visloc_extensions.sets.files import CoarseIndex
from visloc_extensions.sets.mistaken import mistaken_for

APART = np.array([((0, 0, 0), (5, 5, 2)), ((100, 0, 0), (105, 5, 2))], dtype=np.float64)


@pytest.fixture(scope="module")
def room(built_maps: Path) -> Map:
    return MapStore(built_maps).open("room")


def index_with(room: Map, folder: Path, *, first: bool, second: bool) -> CoarseIndex:
    """Index two tiles, each with the photos of the room or with as many that show nothing of it."""
    random = np.random.default_rng(0)
    model = dict(learn(lambda _: room, 1))
    # Without whitening, which takes away what the photos of the only room have in common.
    model["axes"] = random.normal(size=model["axes"].shape).astype(np.float32)
    model["mean"] = np.zeros_like(model["mean"])
    rows = descriptors_of(room, model)
    foreign = random.normal(size=rows.shape).astype(np.float32)
    tiles = [described(rows if has_room else foreign, model) for has_room in (first, second)]
    return coarse_index(iter(tiles), model, folder / "lists")


def test_a_tile_is_mistaken_for_one_that_shows_its_photos_better(room: Map, tmp_path: Path) -> None:
    """The first tile's index forgot what its photos look like; the second one's did not."""
    index = index_with(room, tmp_path, first=False, second=True)

    assert mistaken_for(lambda _: room, APART, index)[0] == (1,)


def test_tiles_of_the_same_place_are_not_compared(room: Map, tmp_path: Path) -> None:
    index = index_with(room, tmp_path, first=False, second=True)
    together = np.array([APART[0], APART[0] + 1.0])

    assert mistaken_for(lambda _: room, together, index) == [(), ()]
