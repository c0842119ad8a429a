"""The photos of a request to a set of maps; they limit how many decoded photos are in memory."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Sequence
from time import time
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from service.engine.instant_tasks import together
from service.values import MapFolder, PackedQuery, Query
from service.workers.pool import Workers
from service.workers.tasks import Vision
from visloc.options import LocalizeOptions
from visloc.sets.choosing import TileScore
from visloc.types import Refusal

T = TypeVar("T")


class Slots:
    """Slots for decoded photos, which take much more memory than encoded ones.

    Attributes:
        waiting: number of photos that wait for a slot.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self._free = asyncio.Semaphore(count)
        self._turn = asyncio.Lock()
        self.waiting = 0

    async def take(self, photos: int) -> int:
        """Wait for a slot for each photo, at most all slots; return how many were taken."""
        taken = 0
        self.waiting += photos
        try:
            # One request at a time, because two that each hold half of their slots would deadlock.
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

    def give_back(self, slots: int) -> None:
        for _ in range(slots):
            self._free.release()


class SetPhotos:
    """The photos of a request to a set. Within ``async with``, they hold slots.

    Attributes:
        queries: the photos; those that could be decoded are packed.
    """

    def __init__(
        self,
        slots: Slots,
        workers: Workers,
        map_set: MapFolder,
        queries: Sequence[Query],
        options: LocalizeOptions,
    ) -> None:
        self._slots, self._workers, self._set, self._options = slots, workers, map_set, options
        self._sent = self.queries = tuple(queries)
        self._submitted = time()
        self._num_slots = 0

    async def __aenter__(self) -> SetPhotos:
        await self._enter()
        return self

    async def __aexit__(self, *_: object) -> None:
        self._leave()

    @property
    def any_decoded(self) -> bool:
        return any(isinstance(query, PackedQuery) for query in self.queries)

    async def rank(
        self, allowed: NDArray[np.bool_] | None, refused: Refusal | None = None
    ) -> list[tuple[TileScore, ...]]:
        """Decode the photos if they are not decoded yet, and rank tiles by each.

        Args:
            allowed: (T,) the tiles to rank; None to rank none.
            refused: of the photo as it was sent, to rank tiles by other turns of it.
        """
        asked = self._set, self._options, allowed, self._submitted, refused
        ranked = await together(
            self._workers.run(Vision.rank_tiles, query, *asked) for query in self.queries
        )
        self.queries = tuple(one.query for one in ranked)
        self._submitted = time()  # the next wait begins here
        return [one.scores for one in ranked]

    async def aside(self, work: Awaitable[T]) -> T:
        """Release the slots during long work, and decode the photos again after it."""
        self.queries = self._sent
        self._leave()
        result = await work
        await self._enter()
        await self.rank(None)
        return result

    async def _enter(self) -> None:
        self._num_slots = await self._slots.take(len(self._sent))

    def _leave(self) -> None:
        held, self._num_slots = self._num_slots, 0
        self._slots.give_back(held)
