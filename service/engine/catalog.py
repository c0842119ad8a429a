"""Which maps there are and which versions of them are served, in the main process."""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from collections.abc import AsyncIterator, Coroutine, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, suppress
from copy import copy
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

from service.engine.gather import together
from service.engine.listing import Listing
from service.engine.stores import Store
from service.values import Near, Where
from service.workers import process as worker
from service.workers.pool import Workers
from service.workers.process import MapFolder
from visloc.archive import SetOutline, read_any_outline
from visloc.archive.set_rules import refuse_if_tile
from visloc.archive.store import version_in_use
from visloc.errors import MapCorrupt, NotFound, Unavailable, VislocError, refuse

logger = logging.getLogger(__name__)

# How long a version that could not be opened is left alone before it is tried again.
RETRY_AFTER_S = 10.0
# How often the store is asked what has become current, besides by requests.
FOLLOW_S = 1.0
# How often it is looked whether the last request of a version has ended, and how long at most
# before it is closed all the same.
_UNUSED_POLL_S = 0.05
_FORGET_LIMIT_S = 600.0
# Maps that are fetched at once.
_MAX_FETCHES = 4


@dataclass(frozen=True, slots=True)
class _Refused:
    """What is current in the store and could not be loaded.

    Attributes:
        ref: ``id@version``; ``id`` when the map does not say which version is current.
        error: why.
        at: when, by ``perf_counter``.
    """

    ref: str
    error: VislocError
    at: float


class Catalog:
    """Knows what is served. Used from one event loop; what may block runs in threads.

    The store is asked every time which version is current, so that a map that was published a
    moment ago is served without a restart. It takes over when a worker process has it open and
    warm; until then, and when it cannot be opened, the version before it stays in service.

    Args:
        store: where the maps are.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        # Fetching a map may take minutes, in which everything else that needs a thread goes on.
        self._fetchers = ThreadPoolExecutor(_MAX_FETCHES, thread_name_prefix="fetch")
        self._fetching: dict[str, asyncio.Future[Path]] = {}  # by id@version
        self._serving: dict[str, MapFolder] = {}  # by map id
        self.listing = Listing(store, self._serving)
        self._refused: dict[str, _Refused] = {}  # by map id
        self._taking_over: dict[str, asyncio.Task[None]] = {}  # by map id
        self._sets: dict[str, SetOutline | None] = {}  # by id@version; None: it is a map
        self._known: dict[str, MapFolder] = {}  # by id@version, what was asked for and may be open
        self._users: Counter[str] = Counter()  # requests under way, by id@version
        self._leaving: set[str] = set()  # id@version of what is being deleted
        self._background: set[asyncio.Task[None]] = set()

    @property
    def known(self) -> tuple[MapFolder, ...]:
        """What may be open: what is served, and versions that were asked for, as sets do."""
        return tuple(self._known.values())

    @property
    def not_loaded(self) -> Mapping[str, VislocError]:
        """Why the current version of a map cannot be served, by map id."""
        return {map_id: refused.error for map_id, refused in sorted(self._refused.items())}

    async def load_all(self, workers: Workers, max_bytes: int) -> None:
        """Open all current maps, as far as there is room; others are opened when asked for.

        Sets come first, and their tiles last, the first ones only. One that is broken does not
        keep back the others.
        """
        for ref in await asyncio.to_thread(self.listing.opened_at_start):
            if sum(workers.loaded.values()) >= max_bytes:
                logger.info("max_loaded_bytes is full: other maps are opened when they are asked")
                break
            try:
                if "@" in ref:
                    of = await self._open(ref, workers)
                    self._in_background(workers.run_everywhere(worker.load, of))
                else:
                    await self._resolve(ref, workers)
            except VislocError as error:
                logger.error("map %s is not loaded: %s", ref, error)  # noqa: TRY400
        if self._background:
            await asyncio.wait(self._background)  # in every process, not only in the first

    async def follow(self, workers: Workers) -> None:
        """Let versions that become current take over, and forget maps that go, for ever."""
        while True:
            await asyncio.sleep(FOLLOW_S)
            try:
                ids = set(await asyncio.to_thread(self._store.ids))
            except (VislocError, OSError) as error:  # of this task, nobody asks what became
                logger.warning("the maps cannot be listed: %s", error)
                continue
            for map_id in (self._serving.keys() | self._refused.keys()) - ids:
                self._gone(map_id, workers)
            for map_id in self._serving.keys() & ids:
                with suppress(VislocError):  # noted in not_loaded
                    await self._resolve(map_id, workers)

    @asynccontextmanager
    async def using(self, where: Where, workers: Workers) -> AsyncIterator[tuple[MapFolder, ...]]:
        """Give the maps to search; they stay until the block ends, whatever takes over.

        Raises:
            NotFound: ``map.unknown``, ``map.version``, ``map.none_near``.
            VislocError: what the store and ``worker.load`` raise.
        """
        if isinstance(where, Near):
            refs = await asyncio.to_thread(self.listing.searched_near, where)
        else:
            refs = where
        taken: list[MapFolder] = []
        try:
            for ref in refs:
                taken.append(await self._take(ref, workers))
            yield tuple(taken)
        finally:
            for of in taken:
                self._give_back(of.ref)

    async def away(self, refs: Sequence[str]) -> tuple[str, ...]:
        """Say which versions are to be fetched before they can be used."""

        def away(ref: str) -> bool:
            try:
                return self._store.at_hand(ref) is None
            except VislocError:
                return False  # using it says what is wrong

        return tuple([ref for ref in refs if await asyncio.to_thread(away, ref)])

    async def fetch(self, refs: Sequence[str]) -> dict[str, VislocError]:
        """Bring versions to this machine; say of which that failed."""

        async def fetched(ref: str) -> VislocError | None:
            try:
                await self._folder(ref)
            except VislocError as error:
                return error
            return None

        errors = await together(fetched(ref) for ref in refs)
        return {ref: error for ref, error in zip(refs, errors, strict=True) if error is not None}

    @asynccontextmanager
    async def reading(self, ref: str) -> AsyncIterator[MapFolder]:
        """Give ``id@version``, to be read in this process; it stays until the block ends.

        Raises:
            NotFound: ``map.version``.
            VislocError: what the store raises.
        """
        of = await self._hold(ref)
        try:
            yield of
        finally:
            self._give_back(of.ref)

    async def activate(self, map_id: str, version: str, workers: Workers) -> None:
        """Put a version into use, once a worker process has it open and warm.

        Raises:
            VislocError: as ``using``; then nothing has changed.
        """
        of = await self._open(f"{map_id}@{version}", workers)
        await asyncio.to_thread(self._store.set_current, map_id, version)
        self._serve(map_id, of, workers)

    def close(self) -> None:
        """Let go of the threads."""
        self._fetchers.shutdown(wait=False, cancel_futures=True)

    async def delete(self, map_id: str, version: str, workers: Workers, limit_s: float) -> None:
        """Delete a version that is not in use, after the requests that began with it.

        Args:
            map_id: the map.
            version: of it.
            workers: that may have it open.
            limit_s: longest time to wait for those requests.

        Raises:
            NotFound: ``map.unknown``, ``map.version``.
            Conflict: ``map.version_in_use``, ``map.in_set``.
        """
        ref = f"{map_id}@{version}"
        # One that answers while the current one cannot be opened is in use too.
        others = set(await asyncio.to_thread(self._store.versions, map_id)) - {version}
        if others and any(of.ref == ref for of in self._serving.values()):
            raise version_in_use(map_id, version, sorted(others))
        # Before anyone is turned away from it.
        await asyncio.to_thread(self._refuse_if_tile, map_id, version)
        self._leaving.add(ref)
        try:
            await self._until_unused(ref, limit_s)
            if self._users[ref]:
                raise version_in_use(map_id, version, sorted(others))
            await asyncio.to_thread(self._store.remove, map_id, version)
        finally:
            self._leaving.discard(ref)
        self.listing.forget(ref)
        if map_id in self._serving and not others:
            del self._serving[map_id]
        await self._close(ref, workers)

    def set_outline(self, of: MapFolder) -> SetOutline:
        """Return what a set says about itself that ``using`` gave."""
        outline = self._sets[of.ref]
        assert outline is not None  # the caller has looked
        return outline

    async def _take(self, ref: str, workers: Workers) -> MapFolder:
        """Return a map, which stays until it is given back."""
        while True:
            found = ref if "@" in ref else (await self._resolve(ref, workers)).ref
            try:
                return await self._hold(found)
            except NotFound:
                served = self._serving.get(ref)
                if served is None or served.ref == found:
                    raise
                # Another version took over meanwhile.

    async def _hold(self, ref: str) -> MapFolder:
        """Return ``id@version``, which stays until it is given back."""
        if ref in self._leaving:
            raise refuse("map.version", "the version is being deleted", field="map", got=ref)
        self._users[ref] += 1
        try:
            return await self._at_hand(ref)
        except BaseException:
            self._give_back(ref)
            raise

    def _give_back(self, ref: str) -> None:
        self._users[ref] -= 1
        if not self._users[ref]:
            del self._users[ref]

    async def _until_unused(self, ref: str, limit_s: float) -> None:
        with suppress(TimeoutError):
            async with asyncio.timeout(limit_s):
                while self._users[ref]:
                    await asyncio.sleep(_UNUSED_POLL_S)

    async def _forget(self, ref: str, workers: Workers) -> None:
        """Close a version that another one took over from, after its last request."""
        await self._until_unused(ref, _FORGET_LIMIT_S)
        if any(of.ref == ref for of in self._serving.values()) or self._sets_with(ref):
            return
        await self._close(ref, workers)

    async def _close(self, ref: str, workers: Workers) -> None:
        """Close a version; of a set, later the tiles too that no other set names."""
        outline = self._sets.pop(ref, None)
        self._known.pop(ref, None)
        for tile in () if outline is None else outline.tiles:
            if tile.ref in self._known:
                self._in_background(self._forget(tile.ref, workers))
        await workers.run_everywhere(worker.forget, ref)

    def _sets_with(self, ref: str) -> list[SetOutline]:
        """The sets that are served and name a version."""
        sets = [self._sets.get(of.ref) for of in tuple(self._serving.values())]
        return [of for of in sets if of and any(ref == tile.ref for tile in of.tiles)]

    def _refuse_if_tile(self, map_id: str, version: str) -> None:
        """Refuse to delete a tile of a set that is served and in use; in a thread."""
        for of in self._sets_with(f"{map_id}@{version}"):
            with suppress(NotFound):  # the set was deleted a moment ago
                if self._store.current_version(of.manifest.id) == of.manifest.version:
                    refuse_if_tile(map_id, version, [(of.ref, of.manifest)])

    async def _resolve(self, ref: str, workers: Workers) -> MapFolder:
        """Return what ``id`` stands for: what is current, or the version before it."""
        before, refused = self._serving.get(ref), self._refused.get(ref)
        try:
            current = f"{ref}@{await asyncio.to_thread(self._store.current_version, ref)}"
        except MapCorrupt as error:
            self._refuse(ref, ref, error)
            if before is None:
                raise
            return before
        except NotFound:
            self._gone(ref, workers)
            raise
        if before is not None and before.ref == current:
            self._refused.pop(ref, None)
            return before
        if (
            refused is not None
            and refused.ref == current
            and perf_counter() < refused.at + RETRY_AFTER_S
        ):
            if before is not None:
                return before
            if not isinstance(refused.error, Unavailable):
                raise copy(refused.error)
        task = self._taking_over.get(ref)
        if task is None:
            task = asyncio.create_task(self._take_over(ref, current, workers))
            self._taking_over[ref] = task
            task.add_done_callback(lambda _: self._taking_over.pop(ref, None))
        if before is not None:
            return before  # warm, while the new one is made ready
        await asyncio.shield(task)
        found, refused = self._serving.get(ref), self._refused.get(ref)
        if found is None:
            raise copy(refused.error) if refused else _gone_meanwhile(ref)
        return found

    async def _take_over(self, map_id: str, current: str, workers: Workers) -> None:
        try:
            of = await self._open(current, workers)
        except VislocError as error:
            self._refuse(map_id, current, error)
        else:
            self._serve(map_id, of, workers)

    def _serve(self, map_id: str, of: MapFolder, workers: Workers) -> None:
        before = self._serving.get(map_id)
        self._serving[map_id] = of
        self._refused.pop(map_id, None)
        if before is None or before.ref != of.ref:
            logger.info("map %s is served", of.ref)
            self._in_background(workers.run_everywhere(worker.load, of))
            if before is not None:
                self._in_background(self._forget(before.ref, workers))

    def _refuse(self, map_id: str, current: str, error: VislocError) -> None:
        """Note that what is current cannot be served."""
        before, known = self._serving.get(map_id), self._refused.get(map_id)
        self._refused[map_id] = _Refused(current, error, perf_counter())
        if before is not None and (known is None or known.ref != current):
            logger.error(
                "map %s cannot take over, %s stays in service: %s", current, before.ref, error
            )

    def _gone(self, map_id: str, workers: Workers) -> None:
        self._refused.pop(map_id, None)
        before = self._serving.pop(map_id, None)
        if before is not None:
            self._in_background(self._forget(before.ref, workers))

    async def _open(self, ref: str, workers: Workers) -> MapFolder:
        """Open a version in one of the processes, and warm it up."""
        of = await self._at_hand(ref)
        await workers.run(worker.load, of)
        return of

    async def _at_hand(self, ref: str) -> MapFolder:
        """Return a version on this machine's disk, and whether it is a set."""
        # Asked every time: copies of a remote store come and go by their use.
        folder = await self._folder(ref)
        if ref not in self._sets:
            outline = await asyncio.to_thread(read_any_outline, folder)
            self._sets[ref] = outline if isinstance(outline, SetOutline) else None
        self._known[ref] = MapFolder(ref, folder, self._sets[ref] is not None)
        return self._known[ref]

    async def _folder(self, ref: str) -> Path:
        """Return where a version lies on this machine, fetched once for all who wait for it."""
        at_hand = await asyncio.to_thread(self._store.at_hand, ref)
        if at_hand is not None:
            return at_hand
        fetching = self._fetching.get(ref)
        if fetching is None:
            loop = asyncio.get_running_loop()
            fetching = loop.run_in_executor(self._fetchers, self._store.folder, ref)
            self._fetching[ref] = fetching

            def fetched(done: asyncio.Future[Path]) -> None:
                self._fetching.pop(ref, None)
                if not done.cancelled():
                    done.exception()  # seen, also when nobody waits for it any more

            fetching.add_done_callback(fetched)
        return await asyncio.shield(fetching)

    def _in_background(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(work)
        self._background.add(task)  # the loop itself keeps only a weak reference
        task.add_done_callback(self._background.discard)


def _gone_meanwhile(map_id: str) -> VislocError:
    return refuse("map.unknown", "the map was deleted a moment ago", field="map", got=map_id)
