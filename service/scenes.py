"""Points and photos of maps, to be drawn: opened, ordered and kept, in the main process."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from functools import partial
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from service.catalog import Catalog
from visloc.archive import MapOutline
from visloc.archive.detail import (
    MapPoints,
    detail_order,
    open_points,
    point_header,
    point_rows,
)
from visloc.archive.photos import MappingPhotos, read_photos
from visloc.errors import VislocError

# So many requests are at work at once: photos that are to be localized go first.
_THREADS = 2
# An order takes four bytes per landmark.
_MAX_ORDERS_BYTES = 128 * 2**20
# About what the name and the pose of a photo take in memory, and room for 100 000 of them.
_PHOTO_BYTES = 320
_MAX_PHOTOS_BYTES = 32 * 2**20
# Rows that are packed at a time, 16 bytes each: what a client does not take, waits here.
_BLOCK = 16_384

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
        self._orders = _Kept[NDArray[np.uint32]](_MAX_ORDERS_BYTES, lambda order: order.nbytes)
        self._photos = _Kept[MappingPhotos](
            _MAX_PHOTOS_BYTES, lambda photos: len(photos.images) * _PHOTO_BYTES
        )

    async def points(
        self, outline: MapOutline, first: int, count: int
    ) -> tuple[int, AsyncGenerator[bytes]]:
        """Return landmarks in their order of detail, packed (docs/api.md), in pieces.

        Args:
            outline: of the version.
            first: place in the order to begin at.
            count: most landmarks to return.

        Returns:
            How many landmarks follow, and the bytes.

        Raises:
            NotFound: ``map.version``.
            MapCorrupt: ``map.array``.
            VislocError: what the store raises.
        """
        async with self._catalog.reading(outline.ref) as of:
            opened = await self._in_thread(partial(open_points, of.folder, outline.manifest))
        # From here on the files may be deleted: what is mapped stays.
        order = await self._orders.get(
            outline.manifest.content_hash,
            lambda: self._in_thread(partial(detail_order, opened.landmarks)),
        )
        rows = order[first : first + count]
        return len(rows), self._packed(opened, rows, first)

    async def photos(self, outline: MapOutline) -> MappingPhotos:
        """Return the mapping photos of a version.

        Raises:
            NotFound: ``map.version``.
            MapCorrupt: ``map.json``, ``map.images``, ``map.array``.
            VislocError: what the store raises.
        """

        async def read() -> MappingPhotos:
            async with self._catalog.reading(outline.ref) as of:
                return await self._in_thread(partial(read_photos, of.folder, outline))

        return await self._photos.get(outline.manifest.content_hash, read)

    def close(self) -> None:
        """Let go of the threads."""
        self._threads.shutdown(wait=False, cancel_futures=True)

    async def _packed(
        self, opened: MapPoints, rows: NDArray[np.uint32], first: int
    ) -> AsyncGenerator[bytes]:
        yield point_header(opened, first, len(rows))
        for start in range(0, len(rows), _BLOCK):
            yield await self._in_thread(partial(point_rows, opened, rows[start : start + _BLOCK]))

    async def _in_thread(self, work: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._threads, work)


class _Kept(Generic[T]):
    """Values by key, each made once for all who ask; the last used ones are kept.

    Args:
        max_bytes: room for them; one that is larger is kept alone.
        size_of: the bytes of one.
    """

    def __init__(self, max_bytes: int, size_of: Callable[[T], int]) -> None:
        self._max_bytes = max_bytes
        self._size_of = size_of
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
        used = sum(map(self._size_of, self._values.values()))
        for oldest in tuple(self._values)[:-1]:
            if used <= self._max_bytes:
                break
            used -= self._size_of(self._values.pop(oldest))
        return value
