"""The photos of a request to a set of maps, with the features found in them so far."""

from __future__ import annotations

from collections.abc import Sequence
from time import time

import numpy as np
from numpy.typing import NDArray

from service.engine.instant_tasks import together
from service.values import MapFolder, PackedQuery, Query
from service.workers.pool import Workers
from service.workers.tasks import Vision
from visloc.options import LocalizeOptions
from visloc.types import Refusal
from visloc_extensions.sets.choosing import RankedTiles, TileScore


class SetPhotos:
    """The photos of a request to a set.

    Attributes:
        queries: the photos; those that could be decoded are packed.
    """

    def __init__(
        self,
        workers: Workers,
        map_set: MapFolder,
        queries: Sequence[Query],
        options: LocalizeOptions,
    ) -> None:
        self._workers, self._set, self._options = workers, map_set, options
        self.queries = tuple(queries)
        self._submitted = time()

    @property
    def any_decoded(self) -> bool:
        return any(isinstance(query, PackedQuery) for query in self.queries)

    async def rank(
        self, allowed: NDArray[np.bool_] | None, refused: Refusal | None = None
    ) -> list[tuple[TileScore, ...]]:
        """Find features where none are found yet, and rank tiles by each photo.

        Args:
            allowed: (T,) the tiles to rank; None to rank none.
            refused: of the photo as it was sent, to rank tiles by other turns of it.
        """
        asked = self._options, allowed, self._submitted, refused
        ranked: list[RankedTiles] = await together(
            self._workers.run(Vision.in_set, self._set, "rank_tiles", query, *asked)
            for query in self.queries
        )
        self.queries = tuple(one.query for one in ranked)
        self._submitted = time()  # the next wait begins here
        return [one.scores for one in ranked]
