"""Points and photos of maps for drawing: read, ordered and cached in the main process.

Files are read, not mapped into memory: one that is truncated meanwhile is an error of one request,
where a mapped one would end the process that answers everybody.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from copy import copy
from functools import partial
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from service.engine.catalog import Catalog
from visloc.archive import MapOutline
from visloc.archive.photos import MappingPhotos, read_photos
from visloc.drawing.detail_levels import detail_order, read_landmarks
from visloc.drawing.point_bytes import read_points
from visloc.errors import VislocError

# Number of requests that read at the same time.
_THREADS = 2
# Number of maps whose orders and photos are kept, whatever their size, because a large map takes
# much longer to order again than a small one. Each takes four bytes per landmark, some hundred per
# photo.
_MAX_ORDERS, _MAX_PHOTOS = 4, 4

T = TypeVar("T")


class Scenes:
    """Points and photos of maps. Used from one event loop; slow work runs in threads.

    A version never changes, so cached results stay valid.
    """

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog
        self._threads = ThreadPoolExecutor(_THREADS, thread_name_prefix="scene")
        # One order at a time bounds the memory, and a thread of its own lets other maps be drawn
        # while a large one is ordered.
        self._one_order = asyncio.Lock()
        self._order_thread = ThreadPoolExecutor(1, thread_name_prefix="order")
        self._orders = _Kept[NDArray[np.uint32]](_MAX_ORDERS)
        self._photos = _Kept[MappingPhotos](_MAX_PHOTOS)

    async def points(self, outline: MapOutline, first: int, count: int) -> bytes:
        """Return ``count`` landmarks of the level-of-detail order, from index ``first`` on.

        They are packed as in docs/api.md.
        """
        manifest = outline.manifest
        order = await self._orders.get(manifest.content_hash, lambda: self._order(outline))
        rows = order[first : first + count].copy()  # a view would keep the whole order
        async with self._catalog.reading(outline.ref) as version:
            work = partial(read_points, version.folder, manifest, rows, first)
            return await _in(self._threads, work)

    async def photos(self, outline: MapOutline) -> MappingPhotos:
        """Return the mapping photos of a version."""

        async def read() -> MappingPhotos:
            async with self._catalog.reading(outline.ref) as version:
                return await _in(self._threads, partial(read_photos, version.folder, outline))

        return await self._photos.get(outline.manifest.content_hash, read)

    def close(self) -> None:
        for threads in (self._threads, self._order_thread):
            threads.shutdown(wait=False, cancel_futures=True)

    async def _order(self, outline: MapOutline) -> NDArray[np.uint32]:
        async with self._one_order:
            async with self._catalog.reading(outline.ref) as version:
                work = partial(read_landmarks, version.folder, outline.manifest)
                landmarks = await _in(self._threads, work)
            return await _in(self._order_thread, partial(detail_order, landmarks))


async def _in(threads: Executor, work: Callable[[], T]) -> T:
    return await asyncio.get_running_loop().run_in_executor(threads, work)


class _Kept(Generic[T]):
    """The ``most`` recently used values by key; concurrent callers share the making of a value."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._values: dict[str, T] = {}  # the most recently used last
        self._making: dict[str, asyncio.Task[T]] = {}

    async def get(self, key: str, make: Callable[[], Awaitable[T]]) -> T:
        """Return a value; make it if necessary, even if the caller is cancelled meanwhile."""
        if key in self._values:
            self._values[key] = self._values.pop(key)
            return self._values[key]
        task = self._making.get(key)
        if task is None:
            task = asyncio.create_task(self._make(key, make))
            self._making[key] = task
            task.add_done_callback(lambda done: done.cancelled() or done.exception())  # seen
        try:
            return await asyncio.shield(task)
        except VislocError as error:
            raise copy(error) from error  # every waiting caller gets its own

    async def _make(self, key: str, make: Callable[[], Awaitable[T]]) -> T:
        try:
            value = await make()
        finally:
            del self._making[key]
        self._values[key] = value
        for oldest in tuple(self._values)[: -self._most]:
            del self._values[oldest]
        return value
