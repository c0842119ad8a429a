"""Tiles of a set whose own photos the set would look for elsewhere.

Each tile's photos are asked of the coarse index as if the tile did not have them, as the own test
of a map asks the map. It tells which tiles a query of a poor tile would be placed on.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from mapping.own_test.held_out import spread_photos
from mapping.own_test.trials import left_out_with
from mapping.own_test.verdict import MOST_WRONG
from visloc.archive import Map
from visloc.localization.map_view.constraints import MapGeometry
from visloc_extensions.sets.choosing import TileScore, plan
from visloc_extensions.sets.coarse import descriptor_of, ranked, score_without, words_of
from visloc_extensions.sets.files import CoarseIndex
from visloc_extensions.sets.unheard import apart

# Photos that are asked: so many of each tile, of a large set fewer, but at least one.
_OF_A_TILE, _IN_ALL = 12, 6000


def mistaken_for(
    open_tile: Callable[[int], Map], boxes: NDArray[np.float64], coarse: CoarseIndex
) -> list[tuple[int, ...]]:
    """Return for each tile the rows of those that its photos are mistaken for.

    A photo is mistaken for one of other tiles when these would be searched first, and without its
    own tile, which is scored without the photo and those taken near it. More than 15 % of the
    photos that are asked make a tile count, as in a map's own test (decision 0032). Tiles whose
    photos lie among each other show the same place.

    Args:
        open_tile: opens a tile by its row.
        boxes: (T, 2, 3) of the tiles' photos in the set.
    """
    most = max(1, min(_OF_A_TILE, _IN_ALL // len(boxes)))
    found: list[tuple[int, ...]] = []
    for tile in range(len(boxes)):
        others = apart(boxes, tile)
        if not others.any():
            found.append(())
            continue
        opened = open_tile(tile)
        counts, asked = np.zeros(len(boxes), np.int64), 0
        viewpoints = MapGeometry(opened).viewpoints
        for photo in spread_photos(len(opened.images), most):
            left_out = left_out_with(opened, viewpoints, photo)
            query = descriptor_of(words_of(opened, photo), coarse.model)
            if left_out is None or not query.any():
                continue
            asked += 1
            own = score_without(coarse, query, tile, left_out)
            scores = [*ranked(coarse, query, others), TileScore(tile, own)]
            first, _ = plan(sorted(scores, key=lambda each: -each.score))
            if tile not in first:
                counts[list(first)] += 1
        found.append(tuple(np.flatnonzero(counts > MOST_WRONG * asked).tolist()))
    return found
