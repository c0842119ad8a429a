"""Maps loaded, work queued, warm workers. Knows neither HTTP nor gRPC."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import cv2
import torch

from visloc.archive import Map, MapStore
from visloc.errors import Conflict, InvalidInput, MapCorrupt, Overloaded, Unavailable, VislocError
from visloc.features import LocalFeatureExtractor, make_local_features
from visloc.geometry import Camera
from visloc.images import ImageLimits, read_photo
from visloc.localizer import Localizer
from visloc.types import Answer, LocalizeOptions

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class LocalizeJob:
    """One photo to localize.

    Attributes:
        map: ``id``, for its current version, or ``id@version``.
        image: the encoded photo.
        camera: its intrinsics for the pixels as stored; None when unknown.
        options: thresholds and the like.
    """

    map: str
    image: bytes
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
        not_loaded: why, by map id, of maps that cannot be loaded.
    """

    ready: bool
    maps: tuple[str, ...]
    not_loaded: Mapping[str, VislocError]


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
        self._refused: set[str] = set()  # id@version that could not take over
        self._not_loaded: dict[str, VislocError] = {}
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
        """What is loaded now."""
        return Status(self._ready, tuple(sorted(self._localizers)), dict(self._not_loaded))

    async def localize(self, job: LocalizeJob) -> Localization:
        """Decode and localize a photo in a worker thread.

        Raises:
            Overloaded: ``server.busy`` when too many photos are waiting.
            Unavailable: ``server.starting`` before ``start`` is done.
            VislocError: what the store, ``read_photo`` and ``Localizer.localize`` raise.
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
        photo = read_photo(job.image, self._limits)
        decoded = perf_counter()
        answer = localizer.localize(photo, job.camera, job.options)
        seconds = {
            "queued": started - submitted,
            "open_map": loaded - started,
            "decode": decoded - loaded,
            **answer.evidence.seconds,
        }
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
                self._not_loaded[map_id] = error
                logger.error("map %s is not loaded: %s", map_id, error)  # noqa: TRY400

    def _localizer(self, ref: str) -> Localizer:
        """Return the localizer of a map, opened now if it was not before."""
        if "@" in ref:
            return self._loaded(ref)
        current = f"{ref}@{self._store.current_version(ref)}"
        before = self._serving.get(ref)
        if before is not None and current in self._refused:
            return self._loaded(before)
        try:
            localizer = self._loaded(current)
        except VislocError as error:
            if before is None:
                raise
            self._refused.add(current)
            message = "map %s cannot take over, %s stays in service: %s"
            logger.error(message, current, before, error)  # noqa: TRY400
            return self._loaded(before)
        if before != current:
            self._serving[ref] = current
            self._not_loaded.pop(ref, None)
            if before is not None:
                self._localizers.pop(before, None)
        return localizer

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
        opened = self._store.open(ref)
        name = opened.manifest.local_features.fingerprint.name
        try:
            if name not in self._extractors:
                self._extractors[name] = make_local_features(name, self._weights_dir)
            localizer = Localizer(opened, self._extractors[name])
        except InvalidInput as error:  # features that are not here: not the caller's mistake
            raise Conflict(
                error.code, error.message, field=error.field, expected=error.expected, got=error.got
            ) from error
        localizer.warm_up()
        logger.info("map %s loaded in %.1f s", opened.ref, perf_counter() - start)
        return localizer

    def _find_map(self, ref: str) -> Map:
        if ref not in self._serving:
            return self._store.open(ref)
        current = f"{ref}@{self._store.current_version(ref)}"
        serving = self._localizers.get(self._serving[ref] if current in self._refused else current)
        return self._store.open(ref) if serving is None else serving.map

    def _list_maps(self) -> list[Map]:
        found = []
        for map_id in self._store.ids():
            try:
                found.append(self._find_map(map_id))
            except MapCorrupt as error:
                logger.warning("map %s is not listed: %s", map_id, error)
        return found
