"""The photos of a request to a set of maps, in the main process: how many are in memory at once."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Sequence
from time import time
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from service.engine.gather import together
from service.values import Query, ReadQuery
from service.workers import process as worker
from service.workers.pool import Workers
from service.workers.process import MapFolder
from visloc.sets.choosing import TileScore
from visloc.types import LocalizeOptions

T = TypeVar("T")


class Places:
    """Room for photos that were read, which take much more memory than those that wait.

    Args:
        count: photos that may be in memory at once; a rig of more has all places.

    Attributes:
        waiting: photos that wait for room.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self._free = asyncio.Semaphore(count)
        self._turn = asyncio.Lock()
        self.waiting = 0

    async def take(self, photos: int) -> int:
        """Wait for room; return how many places were taken."""
        taken = 0
        self.waiting += photos
        try:
            # One request after the other: two that each have half of what they need wait for ever.
            async with self._turn:
                while taken < min(photos, self._count):
                    await self._free.acquire()
                    taken += 1
        except BaseException:
            self.give_back(taken)
            raise
        finally:
            self.waiting -= photos
        return taken

    def give_back(self, places: int) -> None:
        """Let other requests in."""
        for _ in range(places):
            self._free.release()


class SetPhotos:
    """The photos of a request to a set, which hold room from when they are read to the end.

    Args:
        places: where room is taken.
        workers: read them.
        of: the set.
        queries: the photos as they came.
        options: how features are found.

    Attributes:
        queries: the photos, read where they could be.
    """

    def __init__(
        self,
        places: Places,
        workers: Workers,
        of: MapFolder,
        queries: Sequence[Query],
        options: LocalizeOptions,
    ) -> None:
        self._places, self._workers, self._of, self._options = places, workers, of, options
        self._asked = self.queries = tuple(queries)
        self._submitted = time()
        self._places_held = 0

    async def __aenter__(self) -> SetPhotos:
        await self._enter()
        return self

    async def __aexit__(self, *_: object) -> None:
        self._leave()

    @property
    def seen(self) -> bool:
        """Whether any of the photos could be read."""
        return any(isinstance(query, ReadQuery) for query in self.queries)

    async def rank(self, allowed: NDArray[np.bool_] | None) -> list[tuple[TileScore, ...]]:
        """Read the photos, unless they are, and rank tiles by each.

        Args:
            allowed: (T,) the tiles to rank; None to rank none.
        """
        chosen = await together(
            self._workers.run(
                worker.choose_tiles, query, self._of, self._options, allowed, self._submitted
            )
            for query in self.queries
        )
        self.queries = tuple(one.query for one in chosen)
        self._submitted = time()  # the next wait begins here
        return [one.scores for one in chosen]

    async def aside(self, work: Awaitable[T]) -> T:
        """Wait for something long; meanwhile no photo is kept, they are read again after it."""
        self.queries = self._asked
        self._leave()
        found = await work
        await self._enter()
        await self.rank(None)
        return found

    async def _enter(self) -> None:
        self._places_held = await self._places.take(len(self._asked))

    def _leave(self) -> None:
        held, self._places_held = self._places_held, 0
        self._places.give_back(held)
