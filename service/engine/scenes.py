"""Points and photos of maps, to be drawn: read, ordered and kept, in the main process.

This process answers everybody, so nothing of a map is mapped into its memory: a file that is cut
short meanwhile is an error of one request.
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

# So many requests are read at once.
_THREADS = 2
# Of the last maps that were drawn, whatever their size: to make the order of a large map again
# takes much longer than that of a small one. Four bytes per landmark, some hundred per photo.
_MAX_ORDERS, _MAX_PHOTOS = 4, 4

T = TypeVar("T")


class Scenes:
    """Gives points and photos of maps. For one event loop; what takes time runs in threads.

    A version never changes, so that what was computed of one holds as long as it is kept.

    Args:
        catalog: of the maps.
    """

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog
        self._threads = ThreadPoolExecutor(_THREADS, thread_name_prefix="scene")
        # One order at a time, which bounds their memory, and in a thread of its own: those of
        # large maps take long, and other maps are drawn meanwhile.
        self._one_order = asyncio.Lock()
        self._order_thread = ThreadPoolExecutor(1, thread_name_prefix="order")
        self._orders = _Kept[NDArray[np.uint32]](_MAX_ORDERS)
        self._photos = _Kept[MappingPhotos](_MAX_PHOTOS)

    async def points(self, outline: MapOutline, first: int, count: int) -> bytes:
        """Return landmarks in their order of detail, packed (docs/api.md).

        Args:
            outline: of the version.
            first: place in the order to begin at.
            count: most landmarks to return.

        Raises:
            NotFound: ``map.version``.
            MapCorrupt: ``map.array``, ``map.range``.
            VislocError: what the store raises.
        """
        manifest = outline.manifest
        order = await self._orders.get(manifest.content_hash, lambda: self._order(outline))
        rows = order[first : first + count].copy()  # a view would keep the whole order
        async with self._catalog.reading(outline.ref) as of:
            work = partial(read_points, of.folder, manifest, rows, first)
            return await _in(self._threads, work)

    async def photos(self, outline: MapOutline) -> MappingPhotos:
        """Return the mapping photos of a version.

        Raises:
            NotFound: ``map.version``.
            MapCorrupt: ``map.json``, ``map.images``, ``map.array``.
            VislocError: what the store raises.
        """

        async def read() -> MappingPhotos:
            async with self._catalog.reading(outline.ref) as of:
                return await _in(self._threads, partial(read_photos, of.folder, outline))

        return await self._photos.get(outline.manifest.content_hash, read)

    def close(self) -> None:
        """Let go of the threads."""
        for threads in (self._threads, self._order_thread):
            threads.shutdown(wait=False, cancel_futures=True)

    async def _order(self, outline: MapOutline) -> NDArray[np.uint32]:
        async with self._one_order:
            async with self._catalog.reading(outline.ref) as of:
                work = partial(read_landmarks, of.folder, outline.manifest)
                landmarks = await _in(self._threads, work)
            return await _in(self._order_thread, partial(detail_order, landmarks))


async def _in(threads: Executor, work: Callable[[], T]) -> T:
    return await asyncio.get_running_loop().run_in_executor(threads, work)


class _Kept(Generic[T]):
    """Values by key, each made once for all who ask; the last used ones are kept.

    Args:
        most: of them.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._values: dict[str, T] = {}  # the last used one is the last
        self._making: dict[str, asyncio.Task[T]] = {}

    async def get(self, key: str, make: Callable[[], Awaitable[T]]) -> T:
        """Return a value, made if need be; it goes on being made when nobody waits any more."""
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
            raise copy(error) from error  # each who waits gets one of his own

    async def _make(self, key: str, make: Callable[[], Awaitable[T]]) -> T:
        try:
            value = await make()
        finally:
            del self._making[key]
        self._values[key] = value
        for oldest in tuple(self._values)[: -self._most]:
            del self._values[oldest]
        return value
