"""Models of the photos that nothing links to the largest model: other places, or other parts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from mapping.methods.matching.stages import Matches, matches_among
from mapping.methods.sparse.model import SparseModel
from visloc.errors import InvalidInput

# Fewer photos localize too little to be a map of their own.
MIN_PHOTOS = 5

Make = Callable[[Sequence[int], Sequence[Matches]], SparseModel]
"""Makes a model of some photos, by their rows, from the matches between them."""


def models_beside(
    largest: SparseModel, matches: Sequence[Matches], make: Make
) -> list[SparseModel]:
    """Make models of the photos that have no place in a model, until no more can be made.

    No photo is in two of them.

    Args:
        largest: of n photos; None among its views stands for a photo without a place.

    Returns:
        Models of the n photos, each of at least ``MIN_PHOTOS``, the largest first.
    """
    found: list[SparseModel] = []
    left = [row for row, view in enumerate(largest.views) if view is None]
    while len(left) >= MIN_PHOTOS:
        try:
            model = make(left, matches_among(left, matches))
        except InvalidInput:
            break  # what is left shows nothing in common
        model = _of_all(model, left, len(largest.views))
        placed = [row for row in left if model.views[row] is not None]
        if len(placed) < MIN_PHOTOS:
            break
        found.append(model)
        left = [row for row in left if model.views[row] is None]
    return sorted(found, key=lambda each: each.views.count(None))


def _of_all(model: SparseModel, rows: Sequence[int], num_photos: int) -> SparseModel:
    """Number the photos of a model of some photos as among all."""
    views = dict(zip(rows, model.views, strict=True))
    observations = model.observations
    return replace(
        model,
        views=tuple(views.get(row) for row in range(num_photos)),
        observations=replace(observations, views=np.array(rows)[observations.views]),
    )
