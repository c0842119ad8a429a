"""Maps loaded, work queued, warm workers. Knows neither HTTP nor gRPC."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import cv2
import torch

from visloc.archive import Map, MapStore
from visloc.errors import Conflict, InvalidInput, MapCorrupt, Overloaded, Unavailable, VislocError
from visloc.features import LocalFeatureExtractor, make_local_features
from visloc.features.readymade import is_ready_made
from visloc.geometry import Camera
from visloc.images import ImageLimits, read_photo
from visloc.localizer import Localizer
from visloc.types import Answer, LocalizeOptions, QueryFeatures

logger = logging.getLogger(__name__)

# How long a published version that could not take over is left alone before it is tried again.
RETRY_AFTER_S = 30.0


@dataclass(frozen=True, slots=True, eq=False)
class LocalizeJob:
    """One photo to localize.

    Attributes:
        map: ``id``, for its current version, or ``id@version``.
        query: the encoded photo, or the features that were found in it.
        camera: its intrinsics for the pixels as stored; None when unknown.
        options: thresholds and the like.
    """

    map: str
    query: bytes | QueryFeatures
    camera: Camera | None
    options: LocalizeOptions


@dataclass(frozen=True, slots=True, eq=False)
class Localization:
    """An answer and the map that gave it."""

    answer: Answer
    map_id: str
    map_version: str


@dataclass(frozen=True, slots=True)
class Status:
    """What the engine has loaded.

    Attributes:
        ready: whether the maps that were there at the start are open and warm.
        maps: ``id@version`` of what is loaded.
        not_loaded: why the current version of a map cannot be served, by map id. An older
            version of it may be in ``maps``.
    """

    ready: bool
    maps: tuple[str, ...]
    not_loaded: Mapping[str, VislocError]


@dataclass(frozen=True, slots=True)
class _Refused:
    """What is current on disk and could not be loaded.

    Attributes:
        ref: ``id@version``; ``id`` when the map does not say which version is current.
        error: why.
        at: when, by ``perf_counter``.
    """

    ref: str
    error: VislocError
    at: float


class Engine:
    """Localizes photos in the maps of a store, in a bounded pool of threads.

    Every request asks the store again which version is current, so that a map that was published
    a moment ago is served without a restart. A version that cannot be opened leaves the one
    before it in service.

    Args:
        store: where the maps are.
        weights_dir: network weights, for maps whose features need them.
        workers: photos worked on at the same time.
        threads_per_worker: processor threads for one photo. This is set for the whole process.
        max_queue: photos that may wait; one more is refused with ``server.busy``.
        limits: of photos.
    """

    def __init__(
        self,
        store: MapStore,
        *,
        weights_dir: Path | None = None,
        workers: int = 1,
        threads_per_worker: int = 1,
        max_queue: int = 64,
        limits: ImageLimits,
    ) -> None:
        torch.set_num_threads(threads_per_worker)
        cv2.setNumThreads(threads_per_worker)
        self._store = store
        self._weights_dir = weights_dir
        self._limits = limits
        self._pool = ThreadPoolExecutor(workers, thread_name_prefix="vision")
        self._places = threading.BoundedSemaphore(workers + max_queue)
        self._loading = threading.Lock()
        self._localizers: dict[str, Localizer] = {}  # by id@version
        self._extractors: dict[str, LocalFeatureExtractor] = {}  # by name
        self._serving: dict[str, str] = {}  # id -> id@version last served as the current one
        self._refused: dict[str, _Refused] = {}  # by map id
        self._ready = False

    async def start(self) -> None:
        """Open and warm up all current maps. One that is broken does not keep back the others."""
        await asyncio.get_running_loop().run_in_executor(self._pool, self._load_all)
        self._ready = True

    def close(self) -> None:
        """Finish the photos that are being worked on and forget those that wait."""
        self._ready = False
        self._pool.shutdown(wait=True, cancel_futures=True)

    @property
    def status(self) -> Status:
        """What is loaded now, of the maps that are still there."""
        ids = set(self._store.ids())
        return Status(
            self._ready,
            tuple(ref for ref in sorted(self._localizers) if ref.partition("@")[0] in ids),
            {
                map_id: refused.error
                for map_id, refused in sorted(self._refused.items())
                if map_id in ids
            },
        )

    async def localize(self, job: LocalizeJob) -> Localization:
        """Localize a photo, decoded first, or its features, in a worker thread.

        Raises:
            Overloaded: ``server.busy`` when too many photos are waiting.
            Unavailable: ``server.starting`` before ``start`` is done.
            VislocError: what the store, ``read_photo`` and the ``Localizer`` raise.
        """
        if not self._ready:
            raise Unavailable("server.starting", "the maps are being loaded; try again shortly")
        if not self._places.acquire(blocking=False):
            raise Overloaded("server.busy", "too many photos are waiting; try again shortly")
        work = self._pool.submit(self._localize, job, perf_counter())
        # The place is free when the work is done or dropped, not when the caller stops waiting.
        work.add_done_callback(lambda _: self._places.release())
        return await asyncio.wrap_future(work)

    async def maps(self) -> list[Map]:
        """All maps that can be opened, in the version that is served, by id."""
        return await asyncio.to_thread(self._list_maps)

    async def map(self, ref: str) -> Map:
        """One map: ``id``, or ``id@version``.

        Raises:
            VislocError: what the store raises.
        """
        return await asyncio.to_thread(self._find_map, ref)

    def _localize(self, job: LocalizeJob, submitted: float) -> Localization:
        started = perf_counter()
        localizer = self._localizer(job.map)
        loaded = perf_counter()
        before = {"queued": started - submitted, "open_map": loaded - started}
        if isinstance(job.query, QueryFeatures):
            answer = localizer.localize_features(job.query, job.camera, job.options)
        else:
            photo = read_photo(job.query, self._limits)
            before["decode"] = perf_counter() - loaded
            answer = localizer.localize(photo, job.camera, job.options)
        seconds = {**before, **answer.evidence.seconds}
        manifest = localizer.map.manifest
        return Localization(
            replace(answer, evidence=replace(answer.evidence, seconds=seconds)),
            manifest.id,
            manifest.version,
        )

    def _load_all(self) -> None:
        for map_id in self._store.ids():
            try:
                self._localizer(map_id)
            except VislocError as error:
                logger.error("map %s is not loaded: %s", map_id, error)  # noqa: TRY400

    def _localizer(self, ref: str) -> Localizer:
        """Return the localizer of a map, opened now if it was not before."""
        if "@" in ref:
            return self._loaded(ref)
        try:
            current = f"{ref}@{self._store.current_version(ref)}"
        except MapCorrupt as error:
            return self._fall_back(ref, ref, error)
        before, refused = self._serving.get(ref), self._refused.get(ref)
        if (
            before is not None
            and refused is not None
            and refused.ref == current
            and perf_counter() < refused.at + RETRY_AFTER_S
        ):
            return self._loaded(before)
        try:
            localizer = self._loaded(current)
        except VislocError as error:
            return self._fall_back(ref, current, error)
        self._refused.pop(ref, None)
        if before != current:
            self._serving[ref] = current
            if before is not None:
                self._localizers.pop(before, None)
        return localizer

    def _fall_back(self, map_id: str, current: str, error: VislocError) -> Localizer:
        """Note that what is current cannot be served, and return what was served before it."""
        before, known = self._serving.get(map_id), self._refused.get(map_id)
        self._refused[map_id] = _Refused(current, error, perf_counter())
        if before is None:
            raise error
        if known is None or known.ref != current:
            logger.error("map %s cannot take over, %s stays in service: %s", current, before, error)
        return self._loaded(before)

    def _loaded(self, ref: str) -> Localizer:
        found = self._localizers.get(ref)
        if found is not None:
            return found
        with self._loading:
            found = self._localizers.get(ref)  # another thread may have been faster
            if found is None:
                found = self._load(ref)
                self._localizers[ref] = found
            return found

    def _load(self, ref: str) -> Localizer:
        start = perf_counter()
        with _damage_named(ref):
            opened = self._store.open(ref)
            name = opened.manifest.local_features.fingerprint.name
            try:
                if name not in self._extractors and not is_ready_made(name):
                    self._extractors[name] = make_local_features(name, self._weights_dir)
                localizer = Localizer(opened, self._extractors.get(name))
            except InvalidInput as error:  # features that are not here: not the caller's mistake
                raise Conflict(
                    error.code,
                    error.message,
                    field=error.field,
                    expected=error.expected,
                    got=error.got,
                ) from error
            localizer.warm_up()
        logger.info("map %s loaded in %.1f s", opened.ref, perf_counter() - start)
        return localizer

    def _find_map(self, ref: str) -> Map:
        wanted = ref if "@" in ref else self._served(ref)
        loaded = self._localizers.get(wanted)
        if loaded is not None:
            return loaded.map
        with _damage_named(wanted):
            return self._store.open(wanted)

    def _served(self, map_id: str) -> str:
        """Return ``id@version`` of what ``id`` stands for."""
        before, refused = self._serving.get(map_id), self._refused.get(map_id)
        try:
            current = f"{map_id}@{self._store.current_version(map_id)}"
        except MapCorrupt:
            if before is None:
                raise
            return before
        return before if before and refused and refused.ref == current else current

    def _list_maps(self) -> list[Map]:
        found = []
        for map_id in self._store.ids():
            try:
                found.append(self._find_map(map_id))
            except VislocError as error:
                logger.warning("map %s is not listed: %s", map_id, error)
        return found


@contextmanager
def _damage_named(ref: str) -> Iterator[None]:
    """Turn what should not happen while a map is opened into MapCorrupt ``map.unusable``.

    A damaged map can break the code that reads it in any way, and must not stop the others.
    """
    try:
        yield
    except VislocError:
        raise
    except Exception as error:
        logger.exception("map %s cannot be used", ref)
        raise MapCorrupt(
            "map.unusable",
            "the map cannot be used; rebuild it, or see the server's log for the cause",
            field=ref,
            got=type(error).__name__,
        ) from error
