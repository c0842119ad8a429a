"""Uploads of packed maps: written to disk as they arrive, verified, published."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, asynccontextmanager
from functools import partial
from pathlib import Path
from typing import ParamSpec, TypeVar

from service.values import MapFolder
from visloc.archive import MapStore
from visloc.archive.packed import unpack_map
from visloc.archive.set_rules import AnyManifest
from visloc.archive.set_schema import SetManifest
from visloc.archive.version_rules import checked_name
from visloc.errors import Conflict, InvalidInput, MapCorrupt, WeightsError, refuse

logger = logging.getLogger(__name__)

# Number of uploads that are written or verified at the same time.
MAX_UPLOADS = 4
# Bytes that are buffered before they are written to disk.
_WRITE_BYTES = 4 * 2**20

P = ParamSpec("P")
T = TypeVar("T")


class Uploads:
    """Publishes uploaded maps. Used from one event loop.

    Args:
        max_bytes: limit of a packed map, and of its files together.
        try_out: opens a verified version as a query does; raises if it cannot be used.
    """

    def __init__(
        self, store: MapStore, max_bytes: int, try_out: Callable[[MapFolder], Awaitable[None]]
    ) -> None:
        self._store, self._max_bytes, self._try_out = store, max_bytes, try_out
        # Verifying gigabytes takes minutes; other work has threads of its own meanwhile.
        self._threads = ThreadPoolExecutor(MAX_UPLOADS, thread_name_prefix="upload")
        self._running: set[str] = set()

    async def publish(self, map_id: str, version: str, chunks: AsyncIterator[bytes]) -> None:
        """Publish a packed map, verified byte by byte, without making it current.

        If the map cannot be published, its body is not read. Even if this is cancelled, temporary
        files are deleted, and the version is published whole or not at all.
        """
        ref = f"{checked_name(map_id, 'map')}@{checked_name(version, 'map version')}"
        if version in await asyncio.to_thread(self._store.versions, map_id):
            raise refuse(
                "map.version_exists",
                field="version",
                expected="a version that is not there",
                got=ref,
            )
        if ref in self._running:
            raise refuse("map.upload_runs", field="version", got=ref)
        self._running.add(ref)
        try:
            async with self._incoming() as folder:
                await self._write(folder / "packed", chunks)
                loop = asyncio.get_running_loop()
                await self._to_end(self._publish, folder, map_id, version, loop)
        finally:
            self._running.discard(ref)

    @asynccontextmanager
    async def _incoming(self) -> AsyncIterator[Path]:
        stack = ExitStack()
        try:
            yield await self._to_end(stack.enter_context, self._store.incoming())
        except BaseException as error:
            await self._to_end(stack.__exit__, type(error), error, error.__traceback__)
            raise
        await self._to_end(stack.close)

    async def _write(self, path: Path, chunks: AsyncIterator[bytes]) -> None:
        size, waiting = 0, bytearray()
        with path.open("xb", buffering=0) as file:

            async def flush() -> None:
                data = memoryview(bytes(waiting))
                waiting.clear()
                while data:
                    data = data[await self._to_end(file.write, data) :]

            async for chunk in chunks:
                size += len(chunk)
                if size > self._max_bytes:
                    raise refuse(
                        "request.too_large",
                        "the packed map has too many bytes",
                        expected=f"at most {self._max_bytes} bytes",
                        got="more",
                    )
                waiting += chunk
                if len(waiting) >= _WRITE_BYTES:
                    await flush()
            await flush()

    def _publish(
        self, folder: Path, map_id: str, version: str, loop: asyncio.AbstractEventLoop
    ) -> None:
        """Unpack, verify, try and publish; in a thread."""
        # In a folder of their own, because a map may have the name of the file beside it.
        packed, target = folder / "packed", folder / "maps" / map_id / version

        def accept(manifest: AnyManifest) -> None:
            tried = MapFolder(f"{map_id}@{version}", target, isinstance(manifest, SetManifest))
            asyncio.run_coroutine_threadsafe(self._tried(tried), loop).result()

        try:
            target.parent.mkdir(parents=True)
            manifest = unpack_map(packed, target, self._max_bytes)
            packed.unlink()
            if (manifest.id, manifest.version) != (map_id, version):
                raise refuse(
                    "packed.renamed",
                    field="version",
                    expected=f"{manifest.id}@{manifest.version}",
                    got=f"{map_id}@{version}",
                )
            self._store.publish(target, map_id, version, make_current=False, accept=accept)
        except MapCorrupt as error:
            # The map was damaged before it arrived. The caller must not learn the server's folders.
            field = None if error.field is None else error.field.removeprefix(f"{target}/")
            raise error.about(field, InvalidInput) from error

    async def _tried(self, version: MapFolder) -> None:
        """Try a version; raise if it can never be used here."""
        try:
            await self._try_out(version)
        except (Conflict, WeightsError) as error:  # not damaged: it has other features
            logger.info("map %s cannot be used here yet: %s", version.ref, error)

    async def _to_end(self, work: Callable[P, T], *given: P.args, **named: P.kwargs) -> T:
        """Run in a thread, and wait for its end even if cancelled.

        Without waiting, files would be deleted while the thread uses them.
        """
        loop = asyncio.get_running_loop()
        task = loop.run_in_executor(self._threads, partial(work, *given, **named))
        cancelled: asyncio.CancelledError | None = None
        while not task.done():
            try:
                await asyncio.wait({task})
            except asyncio.CancelledError as error:
                cancelled = error
        failure = task.exception()  # or it would be logged as never retrieved
        if cancelled is not None:
            raise cancelled
        if failure is not None:
            raise failure
        return task.result()
