"""The engine: a catalog of maps, a bounded queue, and warm worker processes."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import aclosing, contextmanager
from dataclasses import dataclass

from service.engine.catalog import Catalog
from service.engine.instant_tasks import localize_in
from service.engine.scenes import Scenes
from service.engine.searches import SetSearches, answers_of, parted
from service.engine.sequences import SequenceInMaps, SequenceSearch, answers_in_order
from service.engine.uploads import Uploads
from service.errors import stopping_error
from service.telemetry.metrics import Metrics
from service.values import (
    InstantJob,
    Localization,
    MapFolder,
    RigJob,
    SequenceJob,
    ServedMap,
    WorkerSettings,
)
from service.workers.judging import gated, judged
from service.workers.pool import Turn, Workers, using_turn
from service.workers.tasks import Vision
from visloc.archive import MapStore
from visloc.errors import NotFound, VislocError, refuse
from visloc.types import Near

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Status:
    """The state of the engine.

    Attributes:
        ready: whether photos are accepted: the maps to open at start are open and warm, a worker
            process is alive, and the server is not being stopped.
        not_loaded: why the current version of a map cannot be served, by map id. An older
            version of it may be in ``maps``.
    """

    ready: bool
    maps: tuple[str, ...]
    not_loaded: Mapping[str, VislocError]


class Engine:
    """Localizes photos in the maps of a store, in a bounded number of worker processes.

    Used from one event loop.

    Args:
        max_queue: photos that may wait; one more is refused with ``server.busy``.
        max_upload_bytes: largest packed map.
        on_overdue: called for every worker process that is ended (see ``Workers``).
    """

    def __init__(
        self,
        store: MapStore,
        settings: WorkerSettings,
        *,
        workers: int = 1,
        max_queue: int = 64,
        max_batches: int = 8,
        max_upload_bytes: int = 2**34,
        limit_s: float = 60.0,
        metrics: Metrics,
        on_overdue: Callable[[], None],
    ) -> None:
        self._store = store
        self._metrics = metrics
        self.workers = Workers(
            workers,
            settings,
            limit_s=limit_s,
            warm=lambda: self._catalog.known,
            on_death=metrics.observe_worker_death,
            on_overdue=on_overdue,
        )
        self._catalog = Catalog(store, self.workers)
        self.scenes = Scenes(self._catalog)
        self._sets = SetSearches(self._catalog, self.workers, metrics)
        self._max_loaded_bytes = settings.max_loaded_bytes
        self._limit_s = limit_s
        self._max_photos = workers + max_queue
        self._photos = 0
        self._max_batches = max_batches
        self._batches = 0
        self._uploads = Uploads(store, max_upload_bytes, self._try_out)
        self._following: asyncio.Task[None] | None = None
        self._started = False
        self._withdrawn = self._draining = False

    async def start(self) -> None:
        """Open and warm up all current maps; a broken one does not stop the others."""
        await asyncio.to_thread(self._store.sweep)
        if not self.workers.started:
            await self.workers.start()
        await self._catalog.load_all(self._max_loaded_bytes)
        self._following = asyncio.create_task(self._catalog.follow())
        self._started = True

    def withdraw(self) -> None:
        """Report not ready, so that no new work is sent."""
        self._withdrawn = True

    def drain(self) -> None:
        """Refuse new work."""
        self._withdrawn = self._draining = True

    async def close(self) -> None:
        """End the worker processes, and cancel their tasks."""
        self._withdrawn = self._draining = True
        if self._following is not None:
            self._following.cancel()
        self.scenes.close()
        self._catalog.close()
        await self.workers.close()

    @property
    def status(self) -> Status:
        return Status(
            self._started and not self._withdrawn and self.workers.alive > 0,
            tuple(sorted(self.workers.loaded)),
            self._catalog.not_loaded,
        )

    @property
    def draining(self) -> bool:
        """Whether new work is refused, because the server is being stopped."""
        return self._draining

    @property
    def photos(self) -> int:
        """Number of single photos that wait or are being localized."""
        return self._photos

    @property
    def waiting(self) -> int:
        """Number of photos that wait for a worker process."""
        return self.workers.waiting

    @property
    def batches(self) -> int:
        """Number of rigs and sequences that are being served."""
        return self._batches

    async def localize(self, job: RigJob) -> Localization:
        """Localize a single photo, or its features."""
        self.check_room()
        self._photos += 1
        try:
            return await self._search(job)
        finally:
            self._photos -= 1

    def check_room(self) -> None:
        """Refuse a photo before it is read, when too many are waiting."""
        self._check_ready()
        if self._photos >= self._max_photos:
            raise refuse("server.busy", "too many photos are waiting; try again shortly")

    @contextmanager
    def admit_batch(self) -> Iterator[None]:
        """Count a rig or a sequence among those that are served."""
        self._check_ready()
        if self._batches >= self._max_batches:
            raise refuse(
                "server.busy", "too many rigs and sequences are in progress; try again shortly"
            )
        self._batches += 1
        try:
            yield
        finally:
            self._batches -= 1

    async def localize_rig(self, job: RigJob) -> Localization:
        """Localize the images of one instant together, within ``admit_batch``.

        An image that cannot be used fails alone.
        """
        if not job.images:
            raise refuse("rig.empty", "there is no image", field="images")
        return await self._search(job)

    async def _search(self, job: RigJob) -> Localization:
        try:
            return await self._search_once(job)
        except NotFound as error:
            named = not isinstance(job.maps, Near) and any("@" in ref for ref in job.maps)
            if named or error.code != "map.version":
                raise
        # Another server deleted the version before a new process could open it: its successor is
        # served by now, or soon.
        return await self._search_once(job)

    async def _search_once(self, job: RigJob) -> Localization:
        async with self._catalog.using(job.maps) as maps:
            sets, alone = parted(maps, job.priors)
            searches = [self._sets.of(each).localize(job, each) for each in sets]
            if alone:
                searches.append(localize_in(self.workers, job, alone))
            with using_turn(Turn()):
                found = await answers_of(searches)
            return gated(judged(found, job.priors)[1], job.options)

    async def localize_sequence(
        self, start: SequenceJob, instants: AsyncIterator[InstantJob] | Sequence[InstantJob]
    ) -> AsyncGenerator[Localization]:
        """Answer the instants of a sequence in order, each as soon as its answer is final.

        Call it within ``admit_batch``. It takes the next instant only after the caller took the
        previous answers. A list of instants is checked before any work. In a set of maps, only
        their number and order and the names of tiles are checked. With several maps, answers wait
        until only one map explains an instant; that map localizes the rest of the sequence.
        """
        async with self._catalog.using(start.maps) as maps:
            sets, alone = parted(maps, start.priors)
            if sets and len(maps) > 1:
                raise refuse(
                    "sequence.set",
                    field="maps",
                    expected=f"one set, such as {sets[0].ref}, or no set",
                    got=", ".join(each.ref for each in maps),
                )
            if sets:
                search: SequenceSearch = self._sets.of(sets[0]).sequence(start, sets[0])
            else:
                search = SequenceInMaps(self.workers, start, alone)
            async with aclosing(answers_in_order(search, instants)) as answers:
                turn = Turn()  # asked of each time: another task of asyncio may take an answer
                while True:
                    with using_turn(turn):
                        answer = await anext(answers, None)
                    if answer is None:
                        return
                    yield answer

    async def maps(self, near: Near | None = None) -> Sequence[ServedMap]:
        """Return all readable maps in the version that is served, by id.

        Args:
            near: only maps that reach into this circle.
        """
        return await asyncio.to_thread(self._catalog.listing.all, near)

    async def map(self, ref: str) -> ServedMap:
        """Return one map: ``id``, or ``id@version``."""
        return await asyncio.to_thread(self._catalog.listing.describe, ref)

    async def upload(self, map_id: str, version: str, chunks: AsyncIterator[bytes]) -> ServedMap:
        """Publish a packed map after it was verified and tried, without making it current."""
        self._check_ready()

        async def counted() -> AsyncIterator[bytes]:
            async for chunk in chunks:
                self._metrics.observe_uploaded(len(chunk))
                yield chunk

        with self._noted("upload"):
            await self._uploads.publish(map_id, version, counted())
        logger.info("map %s@%s was uploaded", map_id, version)
        return await self.map(f"{map_id}@{version}")

    async def _try_out(self, version: MapFolder) -> None:
        await self.workers.run_again_if_killed(Vision.try_out, version)

    async def set_current(self, map_id: str, version: str) -> ServedMap:
        """Make a version current once a worker process has it open and warm."""
        self._check_ready()
        with self._noted("activate"):
            await self._catalog.activate(map_id, version)
        return await self.map(f"{map_id}@{version}")

    async def delete(self, map_id: str, version: str) -> None:
        """Delete a version that is not current."""
        with self._noted("delete"):
            await self._catalog.delete(map_id, version, self._limit_s)

    @contextmanager
    def _noted(self, change: str) -> Iterator[None]:
        done = False
        try:
            yield
            done = True
        finally:
            self._metrics.observe_map_change(change, done=done)

    def _check_ready(self) -> None:
        if self._draining:
            raise stopping_error()
        if not self._started:
            raise refuse("server.starting")
