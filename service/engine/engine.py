"""Maps served, work queued, warm workers. Knows neither HTTP nor gRPC."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import (
    AsyncGenerator,
    AsyncIterator,
    Iterator,
    Mapping,
    Sequence,
)
from contextlib import aclosing, contextmanager
from dataclasses import dataclass
from time import time

from service.engine.catalog import Catalog
from service.engine.instant_tasks import look, solve_rig, without_photos
from service.engine.listing import ServedMap
from service.engine.scenes import Scenes
from service.engine.set_sequences import SetSequence
from service.engine.sets import SetSearch, answers_of, check_no_tiles, parted
from service.engine.stores import Store
from service.engine.uploads import Uploads
from service.errors import stopping_error
from service.telemetry.metrics import Metrics
from service.values import (
    Instant,
    InstantLocalization,
    Localization,
    LocalizeJob,
    Near,
    RigJob,
    SequenceStart,
)
from service.workers import process as worker
from service.workers.judging import judged
from service.workers.pool import Workers
from service.workers.process import MapFolder, WorkerSettings
from visloc.errors import (
    VislocError,
    refuse,
)
from visloc.priors import NO_PRIORS

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Status:
    """What the engine has loaded.

    Attributes:
        ready: whether photos are accepted: the maps that were there at the start are open and
            warm, a worker process is alive, and the server is not being stopped.
        maps: ``id@version`` of what is loaded.
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
        store: where the maps are.
        settings: of the worker processes.
        workers: photos worked on at the same time.
        max_queue: photos that may wait; one more is refused with ``server.busy``.
        max_batches: rigs and sequences that are served at once.
        max_upload_bytes: largest packed map.
        limit_s: longest time that a worker may take for one step of a request.
        metrics: count what happens to maps and workers.

    Attributes:
        workers: the processes.
        scenes: points and photos of the maps, to be drawn.
    """

    def __init__(
        self,
        store: Store,
        settings: WorkerSettings,
        *,
        workers: int = 1,
        max_queue: int = 64,
        max_batches: int = 8,
        max_upload_bytes: int = 2**34,
        limit_s: float = 60.0,
        metrics: Metrics,
    ) -> None:
        self._store = store
        self._metrics = metrics
        self._catalog = Catalog(store)
        self.scenes = Scenes(self._catalog)
        self.workers = Workers(
            workers,
            settings,
            limit_s=limit_s,
            warm=lambda: self._catalog.known,
            on_death=metrics.observe_worker_death,
        )
        self._sets = SetSearch(self._catalog, self.workers, metrics)
        self._max_loaded_bytes = settings.max_loaded_bytes
        self._limit_s = limit_s
        self._max_photos = workers + max_queue
        self._photos = 0
        self._max_batches = max_batches
        self._batches = 0
        self._uploads = Uploads(store, max_upload_bytes)
        self._following: asyncio.Task[None] | None = None
        self._started = False
        self._withdrawn = self._draining = False

    async def start(self) -> None:
        """Open and warm up all current maps. One that is broken does not keep back the others.

        Raises:
            Unavailable: when the maps cannot be listed, or no process starts; call it again then.
        """
        await asyncio.to_thread(self._store.sweep)
        if not self.workers.started:
            await self.workers.start()
        await self._catalog.load_all(self.workers, self._max_loaded_bytes)
        self._following = asyncio.create_task(self._catalog.follow(self.workers))
        self._started = True

    def withdraw(self) -> None:
        """Say that the server is not ready any more, so that nobody sends it new work."""
        self._withdrawn = True

    def drain(self) -> None:
        """Refuse new work."""
        self._withdrawn = self._draining = True

    async def close(self) -> None:
        """End the worker processes; what they work on is given up."""
        self._withdrawn = self._draining = True
        if self._following is not None:
            self._following.cancel()
        self.scenes.close()
        self._catalog.close()
        await self.workers.close()

    @property
    def status(self) -> Status:
        """What is loaded now."""
        return Status(
            self._started and not self._withdrawn and self.workers.alive > 0,
            tuple(sorted(self.workers.loaded)),
            self._catalog.not_loaded,
        )

    @property
    def draining(self) -> bool:
        """Whether new work is refused, for the server is being stopped."""
        return self._draining

    @property
    def photos(self) -> int:
        """Single photos that wait or are worked on."""
        return self._photos

    @property
    def waiting(self) -> int:
        """Photos that wait for a worker process, or to be read for a set of maps."""
        return self.workers.waiting + self._sets.waiting

    @property
    def batches(self) -> int:
        """Rigs and sequences that are served."""
        return self._batches

    async def localize(self, job: LocalizeJob) -> Localization:
        """Localize a photo, or its features, in a worker process.

        Raises:
            Overloaded: ``server.busy`` when too many photos are waiting.
            Unavailable: ``server.starting`` before ``start`` is done, ``server.worker_died``.
            VislocError: what the store, ``read_photo`` and the ``Localizer`` raise.
        """
        self.check_room()
        self._photos += 1
        try:
            async with self._catalog.using(job.maps, self.workers) as maps:
                sets, alone = parted(maps, job.priors)
                found = [self._sets.localize(job, of) for of in sets]
                if alone:
                    found.append(self.workers.run(worker.localize, job, alone, time()))
                return judged(await answers_of(found), job.priors)[1]
        finally:
            self._photos -= 1

    def check_room(self) -> None:
        """Refuse a photo for which there is no place, before it is read.

        Raises:
            Overloaded: ``server.busy``.
            Unavailable: ``server.starting``, ``server.stopping``.
        """
        self._check_ready()
        if self._photos >= self._max_photos:
            raise refuse("server.busy", "too many photos are waiting; try again shortly")

    @contextmanager
    def admit_batch(self) -> Iterator[None]:
        """Hold one of the places for rigs and sequences.

        Raises:
            Overloaded: ``server.busy`` when all are taken.
            Unavailable: ``server.starting`` before ``start`` is done.
        """
        self._check_ready()
        if self._batches >= self._max_batches:
            raise refuse(
                "server.busy", "too many rigs and sequences are waiting; try again shortly"
            )
        self._batches += 1
        try:
            yield
        finally:
            self._batches -= 1

    async def localize_rig(self, job: RigJob) -> InstantLocalization:
        """Localize the images of one instant together; one that cannot be used fails alone.

        The caller holds a place (``admit_batch``).

        Raises:
            InvalidInput: ``rig.*``, ``options.*``, ``priors.*``.
            Unavailable: ``server.worker_died``.
            VislocError: what the store raises.
        """
        if not job.images:
            raise refuse("rig.empty", "there is no image", field="images")
        async with self._catalog.using(job.maps, self.workers) as maps:
            sets, alone = parted(maps, job.priors)
            found = [self._sets.localize_rig(job, of) for of in sets]
            if alone:
                found.append(solve_rig(self.workers, job, alone))
            return judged(await answers_of(found), job.priors)[1]

    async def localize_sequence(
        self, start: SequenceStart, instants: AsyncIterator[Instant] | Sequence[Instant]
    ) -> AsyncGenerator[InstantLocalization]:
        """Answer the instants of a sequence in order, each as soon as its answer is final.

        The next instant is taken when the answers to those before have been taken; those that
        are all there are checked before any work; in a set of maps, only their order and the names
        of tiles are. The caller holds a place (``admit_batch``).
        With several maps, nothing is answered until one map alone explains an instant: that map is
        kept.

        Raises:
            InvalidInput: ``sequence.*``, ``rig.*``, ``options.*``, ``priors.*``.
            TooLarge: ``sequence.too_many_instants``, ``rig.too_many_images``.
            Unavailable: ``server.worker_died``.
            VislocError: what the store raises.
        """
        async with self._catalog.using(start.maps, self.workers) as maps:
            sets, alone = parted(maps, start.priors)
            if sets and len(maps) > 1:
                raise refuse(
                    "sequence.set",
                    field="maps",
                    expected=f"one set, such as {sets[0].ref}, or no set",
                    got=", ".join(of.ref for of in maps),
                )
            if sets:
                sequence = SetSequence(self._sets, self._catalog, self.workers, start, sets[0])
                if isinstance(instants, Sequence):
                    sequence.check(instants)
                found = sequence.answers(_in_turn(instants))
            else:
                found = self._answers(start, instants, alone)
            async with aclosing(found) as answers:
                async for answer in answers:
                    yield answer

    async def _answers(
        self,
        start: SequenceStart,
        instants: AsyncIterator[Instant] | Sequence[Instant],
        maps: tuple[MapFolder, ...],
    ) -> AsyncGenerator[InstantLocalization]:
        run = self.workers.run
        state = await run(worker.open_sequence, start, maps)
        if isinstance(instants, Sequence):
            for instant in instants:
                check_no_tiles(maps, instant.priors or NO_PRIORS)
            bare = [without_photos(instant) for instant in instants]
            state, _ = await run(worker.check_instants, state, maps, 0, bare)
        index = 0
        try:
            async for instant in _in_turn(instants):
                bare = [without_photos(instant)]
                state, (priors,) = await run(worker.check_instants, state, maps, index, bare)
                check_no_tiles(maps, priors)
                seen = await look(
                    self.workers, maps, start.rig, instant.images, start.options, priors
                )
                added = await run(worker.add_instant, state, maps, bare[0], seen, priors)
                state = added.state
                maps = tuple(of for of in maps if of.ref in added.maps)
                for answer in added.answers:
                    yield answer
                index += 1
        except VislocError:
            # What is wrong with one instant does not take the answers of those before it along.
            if index > 0:
                for answer in await run(worker.finish_sequence, state, maps):
                    yield answer
            raise
        for answer in await run(worker.finish_sequence, state, maps):
            yield answer

    async def maps(self, near: Near | None = None) -> Sequence[ServedMap]:
        """All maps that can be opened, in the version that is served, by id.

        Args:
            near: only those that reach into this circle.
        """
        return await asyncio.to_thread(self._catalog.listing.all, near)

    async def map(self, ref: str) -> ServedMap:
        """One map: ``id``, or ``id@version``.

        Raises:
            VislocError: what the store raises.
        """
        return await asyncio.to_thread(self._catalog.listing.describe, ref)

    async def upload(self, map_id: str, version: str, chunks: AsyncIterator[bytes]) -> ServedMap:
        """Publish a packed map, verified byte by byte; it is not put into use.

        Args:
            map_id: of the map that is packed.
            version: its version.
            chunks: the packed file.

        Raises:
            VislocError: what ``Uploads.publish`` raises.
        """

        async def counted() -> AsyncIterator[bytes]:
            async for chunk in chunks:
                self._metrics.observe_uploaded(len(chunk))
                yield chunk

        with self._noted("upload"):
            await self._uploads.publish(map_id, version, counted())
        logger.info("map %s@%s was uploaded", map_id, version)
        return await self.map(f"{map_id}@{version}")

    async def set_current(self, map_id: str, version: str) -> ServedMap:
        """Put a version into use, once a worker process has it open and warm.

        Raises:
            NotFound: ``map.unknown``, ``map.version``.
            Conflict: ``map.features``, when its features are not here.
            VislocError: what the store raises; then the version before stays in use.
        """
        self._check_ready()
        with self._noted("activate"):
            await self._catalog.activate(map_id, version, self.workers)
        return await self.map(f"{map_id}@{version}")

    async def delete(self, map_id: str, version: str) -> None:
        """Delete a version that is not in use.

        Raises:
            NotFound: ``map.unknown``, ``map.version``.
            Conflict: ``map.version_in_use``.
        """
        with self._noted("delete"):
            await self._catalog.delete(map_id, version, self.workers, self._limit_s)

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


def _in_turn(instants: AsyncIterator[Instant] | Sequence[Instant]) -> AsyncIterator[Instant]:
    return _one_by_one(instants) if isinstance(instants, Sequence) else instants


async def _one_by_one(instants: Sequence[Instant]) -> AsyncGenerator[Instant]:
    for instant in instants:
        yield instant
