"""The maps and versions that are served, in the main process."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Coroutine, Mapping
from contextlib import asynccontextmanager, suppress
from copy import copy
from dataclasses import dataclass
from time import perf_counter
from typing import Any

from service.engine.fetching import Fetcher
from service.engine.listing import Listing
from service.values import MapFolder, Where
from service.workers.pool import Workers
from service.workers.tasks import Vision
from visloc.archive import MapStore, SetOutline, read_any_outline
from visloc.archive.set_rules import refuse_if_tile
from visloc.archive.version_rules import version_in_use
from visloc.errors import MapCorrupt, NotFound, Unavailable, VislocError, refuse
from visloc.types import Near

logger = logging.getLogger(__name__)

# Time after which a version that could not be opened is tried again.
RETRY_AFTER_S = 10.0
# Time between two questions to the store for new versions; requests ask as well.
FOLLOW_S = 1.0
# Time between two checks whether requests still use a version, and the time after which it is
# closed anyway.
_UNUSED_POLL_S = 0.05
_FORGET_LIMIT_S = 600.0


@dataclass(frozen=True, slots=True)
class _Refused:
    """A version that is current in the store but could not be loaded.

    Attributes:
        ref: ``id@version``; ``id`` when the store cannot tell which version is current.
        at: time of the attempt, by ``perf_counter``.
    """

    ref: str
    error: VislocError
    at: float

    @property
    def is_recent(self) -> bool:
        return perf_counter() < self.at + RETRY_AFTER_S


@dataclass(slots=True, eq=False)
class _Served:
    """The version of a map that is served, and the state of the store's current one."""

    version: MapFolder | None = None
    refused: _Refused | None = None
    taking_over: asyncio.Task[None] | None = None


@dataclass(slots=True, eq=False)
class _Version:
    """A version that is used, or may be open in worker processes.

    Attributes:
        folder: None until it is on this machine and read.
        outline: of a set; None for a map.
        users: number of requests that use it.
    """

    folder: MapFolder | None = None
    outline: SetOutline | None = None
    users: int = 0
    is_leaving: bool = False


class Catalog:
    """Tracks the versions that are served. Used from one event loop; blocking work runs in threads.

    Every request asks the store which version is current, so a new map or version is served without
    a restart. A new version takes over when a worker process has it open and warm. Until then, or
    if it cannot be opened, the previous version is served.
    """

    def __init__(self, store: MapStore, workers: Workers) -> None:
        self._store, self._workers = store, workers
        self.fetcher = Fetcher(store)
        self.listing = Listing(store, self._served_ref)
        self._maps: dict[str, _Served] = {}  # by id
        self._versions: dict[str, _Version] = {}  # by id@version
        self._background: set[asyncio.Task[None]] = set()

    @property
    def known(self) -> tuple[MapFolder, ...]:
        """The versions that may be open: current ones, and others that requests or sets name."""
        return tuple(one.folder for one in self._versions.values() if one.folder is not None)

    @property
    def not_loaded(self) -> Mapping[str, VislocError]:
        """Why the current version of a map cannot be served, by map id."""
        refused = [(map_id, one.refused) for map_id, one in sorted(self._maps.items())]
        return {map_id: one.error for map_id, one in refused if one is not None}

    async def load_all(self, max_bytes: int) -> None:
        """Open current maps until ``max_bytes`` are open; requests open the others.

        Sets are opened first, then maps in no set, then the first tiles of sets. A broken map does
        not stop the others.
        """
        for ref in await asyncio.to_thread(self.listing.opened_at_start):
            if sum(self._workers.loaded.values()) >= max_bytes:
                logger.info("max_loaded_bytes is reached: the other maps are opened on request")
                break
            try:
                if "@" in ref:
                    version = await self._open(ref)
                    self._in_background(self._workers.run_everywhere(Vision.load, version))
                else:
                    await self._resolve(ref)
            except VislocError as error:
                logger.error("map %s is not loaded: %s", ref, error)  # noqa: TRY400
        if self._background:
            await asyncio.wait(self._background)  # in every process, not only in the first

    async def follow(self) -> None:
        """Let new current versions take over, and drop maps that were deleted; never returns."""
        while True:
            await asyncio.sleep(FOLLOW_S)
            try:
                ids = set(await asyncio.to_thread(self._store.ids))
            except (VislocError, OSError) as error:  # nobody awaits this task
                logger.warning("the maps cannot be listed: %s", error)
                continue
            for map_id in self._maps.keys() - ids:
                self._gone(map_id)
            for map_id in [one for one in ids if self._served_ref(one) is not None]:
                with suppress(VislocError):  # noted in not_loaded
                    await self._resolve(map_id)

    @asynccontextmanager
    async def using(self, where: Where) -> AsyncIterator[tuple[MapFolder, ...]]:
        """Yield the maps to search. They stay open until the block ends, even if replaced."""
        if isinstance(where, Near):
            refs = await asyncio.to_thread(self.listing.searched_near, where)
        else:
            refs = where
        taken: list[MapFolder] = []
        try:
            for ref in refs:
                taken.append(await self._take(ref))
            yield tuple(taken)
        finally:
            for version in taken:
                self._release(version.ref)

    @asynccontextmanager
    async def reading(self, ref: str) -> AsyncIterator[MapFolder]:
        """Yield ``id@version`` to read in this process; its files stay until the block ends."""
        version = await self._hold(ref)
        try:
            yield version
        finally:
            self._release(ref)

    async def activate(self, map_id: str, version: str) -> None:
        """Make a version current once a worker process has it open and warm."""
        opened = await self._open(f"{map_id}@{version}")
        await asyncio.to_thread(self._store.set_current, map_id, version)
        self._serve(map_id, opened)

    async def delete(self, map_id: str, version: str, limit_s: float) -> None:
        """Delete a version that is not current; wait ``limit_s`` for requests that use it."""
        ref = f"{map_id}@{version}"
        with suppress(VislocError):  # noted in not_loaded
            # A request that began before the last change may have brought the older version back.
            await self._resolve(map_id)
        # If the current version cannot be opened, the one that answers instead counts as current.
        others = set(await asyncio.to_thread(self._store.versions, map_id)) - {version}
        if others and self._is_served(ref):
            raise version_in_use(map_id, version, sorted(others))
        # Before new requests are refused.
        await asyncio.to_thread(self._refuse_if_tile, map_id, version)
        leaving = self._versions.setdefault(ref, _Version())
        leaving.is_leaving = True
        try:
            await self._until_unused(ref, limit_s)
            if leaving.users:
                raise version_in_use(map_id, version, sorted(others))
            await asyncio.to_thread(self._store.remove, map_id, version)
        finally:
            leaving.is_leaving = False
            self._drop_if_idle(ref)
        self.listing.forget(ref)
        served = self._maps.get(map_id)
        if served is not None and not others:
            served.version = None
        await self._close(ref)

    def set_outline(self, version: MapFolder) -> SetOutline:
        """Return the outline of a set that ``using`` gave."""
        outline = self._versions[version.ref].outline
        assert outline is not None  # the caller has looked
        return outline

    def close(self) -> None:
        self.fetcher.close()

    async def _take(self, ref: str) -> MapFolder:
        """Return a map, which stays open until it is released."""
        while True:
            found = ref if "@" in ref else (await self._resolve(ref)).ref
            try:
                return await self._hold(found)
            except NotFound:
                if "@" in ref:
                    raise
                # Another server may have replaced and deleted it, while this one still opens its
                # successor.
                await self._resolve(ref)
                served = self._maps.get(ref)
                if served is not None and served.taking_over is not None:
                    await asyncio.shield(served.taking_over)
                if self._served_ref(ref) in (None, found):
                    raise

    async def _hold(self, ref: str) -> MapFolder:
        """Return ``id@version``, which stays open until it is released."""
        version = self._versions.setdefault(ref, _Version())
        if version.is_leaving:
            raise refuse("map.version", "the version is being deleted", field="map", got=ref)
        version.users += 1
        try:
            return await self._prepare(ref)
        except BaseException:
            self._release(ref)
            raise

    def _release(self, ref: str) -> None:
        self._versions[ref].users -= 1
        self._drop_if_idle(ref)

    def _drop_if_idle(self, ref: str) -> None:
        version = self._versions.get(ref)  # two requests may delete the same version
        if version is None:
            return
        if version.folder is None and not version.users and not version.is_leaving:
            del self._versions[ref]

    async def _until_unused(self, ref: str, limit_s: float) -> None:
        with suppress(TimeoutError):
            async with asyncio.timeout(limit_s):
                while ref in self._versions and self._versions[ref].users:
                    await asyncio.sleep(_UNUSED_POLL_S)

    async def _forget(self, ref: str) -> None:
        """Close a version that another one replaced, after its last request."""
        await self._until_unused(ref, _FORGET_LIMIT_S)
        if not self._is_served(ref) and not self._sets_with(ref):
            await self._close(ref)

    async def _close(self, ref: str) -> None:
        """Close a version; of a set, also close the tiles that no other set names."""
        version = self._versions.get(ref)
        if version is not None:
            tiles = () if version.outline is None else version.outline.tiles
            version.folder = version.outline = None
            self._drop_if_idle(ref)
            for tile in tiles:
                known = self._versions.get(tile.ref)
                if known is not None and known.folder is not None:
                    self._in_background(self._forget(tile.ref))
        await self._workers.run_everywhere(Vision.forget, ref)

    def _served_ref(self, map_id: str) -> str | None:
        """Return ``id@version`` of the version of a map that is served; also called in threads."""
        served = self._maps.get(map_id)
        return None if served is None or served.version is None else served.version.ref

    def _is_served(self, ref: str) -> bool:
        return self._served_ref(ref.partition("@")[0]) == ref

    def _sets_with(self, ref: str) -> list[SetOutline]:
        """Return the served sets that name a version; also called in threads."""
        served = [self._versions.get(self._served_ref(one) or "") for one in tuple(self._maps)]
        sets = [one.outline for one in served if one is not None and one.outline is not None]
        return [one for one in sets if any(ref == tile.ref for tile in one.tiles)]

    def _refuse_if_tile(self, map_id: str, version: str) -> None:
        """Refuse to delete a tile of a set that is served and in use; in a thread."""
        for each in self._sets_with(f"{map_id}@{version}"):
            with suppress(NotFound):  # the set was deleted a moment ago
                if self._store.current_version(each.manifest.id) == each.manifest.version:
                    refuse_if_tile(map_id, version, [(each.ref, each.manifest)])

    async def _resolve(self, map_id: str) -> MapFolder:
        """Return the current version of a map, or the one before it."""
        try:
            current = f"{map_id}@{await asyncio.to_thread(self._store.current_version, map_id)}"
        except MapCorrupt as error:
            self._refuse(map_id, map_id, error)
            before = self._maps[map_id].version
            if before is None:
                raise
            return before
        except NotFound:
            self._gone(map_id)
            raise
        served = self._maps.setdefault(map_id, _Served())
        before, refused = served.version, served.refused
        if before is not None and before.ref == current:
            served.refused = None
            return before
        if refused is not None and refused.ref == current and refused.is_recent:
            if before is not None:
                return before
            if not isinstance(refused.error, Unavailable):
                raise copy(refused.error)
        if served.taking_over is None:
            served.taking_over = asyncio.create_task(self._take_over(map_id, served, current))
        if before is not None:
            return before  # warm, while the new one is being opened
        await asyncio.shield(served.taking_over)
        if served.version is None:
            raise copy(served.refused.error) if served.refused else _gone_meanwhile(map_id)
        return served.version

    async def _take_over(self, map_id: str, served: _Served, current: str) -> None:
        try:
            version = await self._open(current)
        except VislocError as error:
            self._refuse(map_id, current, error)
        else:
            self._serve(map_id, version)
        finally:
            served.taking_over = None

    def _serve(self, map_id: str, version: MapFolder) -> None:
        served = self._maps.setdefault(map_id, _Served())
        before, served.version, served.refused = served.version, version, None
        if before is None or before.ref != version.ref:
            logger.info("map %s is served", version.ref)
            self._in_background(self._workers.run_everywhere(Vision.load, version))
            if before is not None:
                self._in_background(self._forget(before.ref))

    def _refuse(self, map_id: str, current: str, error: VislocError) -> None:
        """Record that the current version cannot be served."""
        served = self._maps.setdefault(map_id, _Served())
        before, known = served.version, served.refused
        served.refused = _Refused(current, error, perf_counter())
        if before is not None and (known is None or known.ref != current):
            logger.error(
                "map %s cannot be opened; %s stays in service: %s", current, before.ref, error
            )

    def _gone(self, map_id: str) -> None:
        """Stop serving a map that was deleted."""
        served = self._maps.get(map_id, _Served())
        before, served.version, served.refused = served.version, None, None
        if served.taking_over is None:
            self._maps.pop(map_id, None)
        if before is not None:
            self._in_background(self._forget(before.ref))

    async def _open(self, ref: str) -> MapFolder:
        """Open a version in one of the processes, and warm it up."""
        version = await self._prepare(ref)
        await self._workers.run_again_if_killed(Vision.load, version)
        return version

    async def _prepare(self, ref: str) -> MapFolder:
        """Return a version on this machine's disk, and whether it is a set."""
        # Ask every time: unused copies of a remote store are deleted.
        folder = await self.fetcher.folder(ref)
        version = self._versions.get(ref)
        outline: object = None if version is None else version.outline
        if version is None or version.folder is None:
            try:
                outline = await asyncio.to_thread(read_any_outline, folder)
            except MapCorrupt:
                await self.fetcher.folder(ref)  # NotFound, where another server just deleted it
                raise
            version = self._versions.setdefault(ref, _Version())
        version.outline = outline if isinstance(outline, SetOutline) else None
        version.folder = MapFolder(ref, folder, version.outline is not None)
        return version.folder

    def _in_background(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(work)
        self._background.add(task)  # the loop itself keeps only a weak reference
        task.add_done_callback(self._background.discard)


def _gone_meanwhile(map_id: str) -> VislocError:
    return refuse("map.unknown", "the map was deleted a moment ago", field="map", got=map_id)
