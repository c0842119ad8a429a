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

from service import worker
from service.jobs import Near, Where
from service.stores import Store
from service.together import together
from service.worker import MapFolder
from service.workers import Workers
from visloc.archive import MapOutline, SetOutline, read_any_outline
from visloc.archive.store import version_in_use
from visloc.errors import InvalidInput, MapCorrupt, NotFound, Unavailable, VislocError
from visloc.sets.choosing import tiles_near

logger = logging.getLogger(__name__)

# How long a version that could not be opened is left alone before it is tried again.
RETRY_AFTER_S = 10.0
# How often the store is asked what has become current, besides by requests.
FOLLOW_S = 1.0
# Most maps that one request may search.
MAX_MAPS = 16
# How often it is looked whether the last request of a version has ended, and how long at most
# before it is closed all the same.
_UNUSED_POLL_S = 0.05
_FORGET_LIMIT_S = 600.0
# Maps that are fetched at once.
_MAX_FETCHES = 4
# Descriptions of so many versions stay in memory; their arrays stay on disk.
_MAX_DESCRIBED = 1000
# Tiles of sets that are opened at the start; others are when they are asked for. A set may have
# thousands.
_MAX_TILES_AT_START = 100


@dataclass(frozen=True, slots=True, eq=False)
class ServedMap:
    """A version of a map.

    Attributes:
        outline: what it, or a set of maps, says about itself.
        current: whether it is the one in use.
        versions: all published ones of the map, oldest first, and which is in use.
    """

    outline: MapOutline | SetOutline
    current: bool
    versions: tuple[tuple[str, bool], ...]


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
        self._refused: dict[str, _Refused] = {}  # by map id
        self._taking_over: dict[str, asyncio.Task[None]] = {}  # by map id
        self._described: dict[str, MapOutline | SetOutline] = {}  # by id@version
        self._sets: dict[str, SetOutline | None] = {}  # by id@version; None: it is a map
        self._users: Counter[str] = Counter()  # requests under way, by id@version
        self._leaving: set[str] = set()  # id@version of what is being deleted
        self._background: set[asyncio.Task[None]] = set()

    @property
    def serving(self) -> tuple[MapFolder, ...]:
        """What is served, without being asked for by version."""
        return tuple(self._serving.values())

    @property
    def not_loaded(self) -> Mapping[str, VislocError]:
        """Why the current version of a map cannot be served, by map id."""
        return {map_id: refused.error for map_id, refused in sorted(self._refused.items())}

    async def load_all(self, workers: Workers, max_bytes: int) -> None:
        """Open all current maps, as far as there is room; others are opened when asked for.

        Sets come first, and their tiles last, the first ones only. One that is broken does not
        keep back the others.
        """
        for map_id in await asyncio.to_thread(self._opened_at_start):
            if sum(workers.loaded.values()) >= max_bytes:
                logger.info("max_loaded_bytes is full: other maps are opened when they are asked")
                break
            try:
                await self._resolve(map_id, workers)
            except VislocError as error:
                logger.error("map %s is not loaded: %s", map_id, error)  # noqa: TRY400
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
        refs = await self._ids_near(where) if isinstance(where, Near) else where
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
        of = await self._at_hand(f"{map_id}@{version}")
        await workers.run(worker.load, of)
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
            Conflict: ``map.version_in_use``.
        """
        ref = f"{map_id}@{version}"
        # One that answers while the current one cannot be opened is in use too.
        others = set(await asyncio.to_thread(self._store.versions, map_id)) - {version}
        if others and any(of.ref == ref for of in self._serving.values()):
            raise version_in_use(map_id, version, sorted(others))
        self._leaving.add(ref)
        try:
            await self._until_unused(ref, limit_s)
            if self._users[ref]:
                raise version_in_use(map_id, version, sorted(others))
            await asyncio.to_thread(self._store.remove, map_id, version)
        finally:
            self._leaving.discard(ref)
        self._described.pop(ref, None)
        self._sets.pop(ref, None)
        if map_id in self._serving and not others:
            del self._serving[map_id]
        await workers.run_everywhere(worker.forget, ref)

    def set_outline(self, of: MapFolder) -> SetOutline:
        """Return what a set says about itself that ``using`` gave."""
        outline = self._sets[of.ref]
        assert outline is not None  # the caller has looked
        return outline

    async def describe(self, ref: str) -> ServedMap:
        """Describe ``id``, in the version that is served, or ``id@version``.

        Raises:
            VislocError: what the store raises.
        """
        return await asyncio.to_thread(self._describe, ref)

    async def list(self, near: Near | None) -> Sequence[ServedMap]:
        """Describe all maps that can be opened, or those that reach into a circle, by id."""

        def described() -> list[ServedMap]:
            found = []
            for map_id in self._store.ids():
                try:
                    served = self._describe(map_id)
                except VislocError as error:
                    logger.warning("map %s is not listed: %s", map_id, error)
                    continue
                if near is None or _reaches(served.outline, near):
                    found.append(served)
            return found

        return await asyncio.to_thread(described)

    def _opened_at_start(self) -> tuple[str, ...]:
        """Say which maps to open at the start, and in which order; in a thread."""
        sets, maps, tiles = [], [], set[str]()
        for map_id in self._store.ids():
            try:
                outline = self._describe(map_id).outline
            except VislocError:
                maps.append(map_id)  # opening it says what is wrong
                continue
            if isinstance(outline, SetOutline):
                sets.append(map_id)
                tiles.update(tile.map for tile in outline.tiles)
            else:
                maps.append(map_id)
        alone = [map_id for map_id in maps if map_id not in tiles]
        in_sets = [map_id for map_id in maps if map_id in tiles]
        return (*sets, *alone, *in_sets[:_MAX_TILES_AT_START])

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
            raise NotFound("map.version", "the version is being deleted", field="map", got=ref)
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
        self._sets.pop(ref, None)
        if not any(of.ref == ref for of in self._serving.values()):
            await workers.run_everywhere(worker.forget, ref)

    async def _ids_near(self, near: Near) -> tuple[str, ...]:
        # A set is searched instead of its tiles.
        listed = _without_tiles(await self.list(near))
        found = [served.outline.manifest.id for served in listed]
        if not found:
            raise NotFound(
                "map.none_near",
                "no map that is tied to the Earth reaches into this circle",
                field="near",
                expected="a place that a map covers: GET /maps?near=latitude,longitude,radius",
                got=f"{near.latitude:g}, {near.longitude:g}, {near.radius:g} m",
            )
        if len(found) > MAX_MAPS:
            raise InvalidInput(
                "request.map",
                "too many maps reach into this circle",
                field="near.radius",
                expected=f"a circle that at most {MAX_MAPS} maps reach into",
                got=f"{len(found)} maps",
            )
        return tuple(found)

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
            of = await self._at_hand(current)
            await workers.run(worker.load, of)
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

    async def _at_hand(self, ref: str) -> MapFolder:
        """Return a version on this machine's disk, and whether it is a set."""
        # Asked every time: copies of a remote store come and go by their use.
        folder = await self._folder(ref)
        if ref not in self._sets:
            outline = await asyncio.to_thread(read_any_outline, folder)
            self._sets[ref] = outline if isinstance(outline, SetOutline) else None
        return MapFolder(ref, folder, self._sets[ref] is not None)

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

    def _describe(self, ref: str) -> ServedMap:
        """Describe a map; in a thread."""
        map_id, at, version = ref.partition("@")
        try:
            current = self._store.current_version(map_id)
        except (NotFound, MapCorrupt):
            current = ""
        if not at:
            served = self._serving.get(map_id)
            version = current if served is None else served.ref.partition("@")[2]
            if not current:
                self._store.current_version(map_id)  # raises what is wrong
        wanted = f"{map_id}@{version}"
        versions = self._store.versions(map_id)
        outline = self._described.get(wanted) if version in versions else None
        if outline is None:
            outline = self._store.outline(wanted)
            while len(self._described) >= _MAX_DESCRIBED:
                self._described.pop(next(iter(self._described)), None)
            self._described[wanted] = outline
        return ServedMap(outline, version == current, tuple((v, v == current) for v in versions))


def _gone_meanwhile(map_id: str) -> NotFound:
    return NotFound("map.unknown", "the map was deleted a moment ago", field="map", got=map_id)


def _without_tiles(maps: Sequence[ServedMap]) -> list[ServedMap]:
    """Return maps without those that are tiles of a set among them."""
    outlines = [served.outline for served in maps]
    tiles = {tile.map for of in outlines if isinstance(of, SetOutline) for tile in of.tiles}
    return [served for served in maps if served.outline.manifest.id not in tiles]


def _reaches(outline: MapOutline | SetOutline, near: Near) -> bool:
    place = outline.place
    if place is None or place.distance_to(near.latitude, near.longitude) > near.radius:
        return False
    if isinstance(outline, SetOutline):  # between its tiles, there is none of it
        return bool(tiles_near(outline, near.latitude, near.longitude, near.radius).any())
    return True
