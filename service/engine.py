"""Maps loaded, work queued, warm workers. Knows neither HTTP nor gRPC."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import ParamSpec, TypeVar

import cv2
import torch

from service.instants import Target, check_images, check_priors, look_at, rig_in_map
from service.jobs import (
    ImageJob,
    Instant,
    InstantLocalization,
    Localization,
    LocalizeJob,
    Rig,
    RigJob,
    SequenceStart,
)
from service.loaded_maps import LoadedMaps
from service.sequences import SequenceRun
from visloc.archive import Map, MapStore
from visloc.errors import (
    InvalidInput,
    Overloaded,
    Unavailable,
    VislocError,
)
from visloc.images import ImageLimits, read_photo
from visloc.localizer import FeatureCache
from visloc.priors import Priors
from visloc.solving import SeenImage
from visloc.types import Answer, Localized, LocalizeOptions, QueryFeatures

logger = logging.getLogger(__name__)

P = ParamSpec("P")
T = TypeVar("T")


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


class Engine:
    """Localizes photos in the maps of a store, in a bounded pool of threads.

    Args:
        store: where the maps are.
        weights_dir: network weights, for maps whose features need them.
        workers: photos worked on at the same time.
        threads_per_worker: processor threads for one photo. This is set for the whole process.
        max_queue: photos that may wait; one more is refused with ``server.busy``.
        max_batches: rigs and sequences that are served at once.
        max_rig_images: images of one instant.
        max_instants: instants of one sequence.
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
        max_batches: int = 8,
        max_rig_images: int = 16,
        max_instants: int = 1000,
        limits: ImageLimits,
    ) -> None:
        torch.set_num_threads(threads_per_worker)
        cv2.setNumThreads(threads_per_worker)
        self._maps = LoadedMaps(store, weights_dir)
        self._limits = limits
        self._pool = ThreadPoolExecutor(workers, thread_name_prefix="vision")
        self._places = threading.BoundedSemaphore(workers + max_queue)
        self._batches = threading.BoundedSemaphore(max_batches)
        self._max_rig_images = max_rig_images
        self._max_instants = max_instants
        self._ready = False

    async def start(self) -> None:
        """Open and warm up all current maps. One that is broken does not keep back the others."""
        await asyncio.get_running_loop().run_in_executor(self._pool, self._maps.load_all)
        self._ready = True

    def close(self) -> None:
        """Finish the photos that are being worked on and forget those that wait."""
        self._ready = False
        self._pool.shutdown(wait=True, cancel_futures=True)

    @property
    def status(self) -> Status:
        """What is loaded now, of the maps that are still there."""
        return Status(self._ready, self._maps.refs, self._maps.not_loaded)

    async def localize(self, job: LocalizeJob) -> Localization:
        """Localize a photo, decoded first, or its features, in a worker thread.

        Raises:
            Overloaded: ``server.busy`` when too many photos are waiting.
            Unavailable: ``server.starting`` before ``start`` is done.
            VislocError: what the store, ``read_photo`` and the ``Localizer`` raise.
        """
        self._check_ready()
        if not self._places.acquire(blocking=False):
            raise Overloaded("server.busy", "too many photos are waiting; try again shortly")
        work = self._pool.submit(self._localize, job, perf_counter())
        # The place is free when the work is done or dropped, not when the caller stops waiting.
        work.add_done_callback(lambda _: self._places.release())
        return await asyncio.wrap_future(work)

    @contextmanager
    def admit_batch(self) -> Iterator[None]:
        """Hold one of the places for rigs and sequences, from before their images are read.

        Raises:
            Overloaded: ``server.busy`` when all are taken.
            Unavailable: ``server.starting`` before ``start`` is done.
        """
        self._check_ready()
        if not self._batches.acquire(blocking=False):
            raise Overloaded("server.busy", "too many rigs and sequences; try again shortly")
        try:
            yield
        finally:
            self._batches.release()

    async def localize_rig(self, job: RigJob) -> InstantLocalization:
        """Localize the images of one instant together; one that cannot be used fails alone.

        The caller holds a place (``admit_batch``).

        Raises:
            InvalidInput: ``rig.*``, ``priors.*``.
            VislocError: what the store raises.
        """
        if not job.images:
            raise InvalidInput("rig.empty", "there is no image", field="images")
        targets = await self._run(self._targets, job.maps, job.rig)
        for target in targets:
            check_images(job.images, target.rig, self._max_rig_images, "images")
        check_priors(targets, job.priors)
        seen = await self._look(targets, job.images, job.options, job.priors)

        def solve() -> InstantLocalization:
            answers = [
                target.localizer.solve(images, job.options, job.priors, job.timestamp).answer
                for target, images in zip(targets, seen, strict=True)
            ]
            best = max(
                range(len(answers)),
                key=lambda i: (answers[i].pose is not None, answers[i].num_inliers),
            )
            return targets[best].localization(answers[best])

        return await self._run(solve)

    async def localize_sequence(
        self, start: SequenceStart, instants: AsyncIterator[Instant] | Sequence[Instant]
    ) -> AsyncGenerator[InstantLocalization]:
        """Answer the instants of a sequence in order, each as soon as its answer is final.

        The next instant is taken when the answers to those before have been taken; those that
        are all there are checked before any work. The caller holds a place (``admit_batch``).
        With several maps, nothing is answered until an instant is localized: its map is kept.

        Raises:
            InvalidInput: ``sequence.*``, ``rig.*``, ``priors.*``.
            TooLarge: ``sequence.too_many_instants``, ``rig.too_many_images``.
            VislocError: what the store raises.
        """
        targets = await self._run(self._targets, start.maps, start.rig)
        run = SequenceRun(start, targets, self._max_rig_images, self._max_instants)
        if isinstance(instants, Sequence):
            for index, instant in enumerate(instants):
                run.check(index, instant)
            instants = _one_by_one(instants)
        index = 0
        try:
            async for instant in instants:
                priors = run.check(index, instant)
                images = await self._look(run.targets, instant.images, start.options, priors)
                for answer in await self._run(run.add, instant, images, priors):
                    yield run.localization(answer)
                index += 1
        except VislocError:
            # What is wrong with one instant does not take the answers of those before it along.
            if index > 0:
                for answer in await self._run(run.finish):
                    yield run.localization(answer)
            raise
        for answer in await self._run(run.finish):
            yield run.localization(answer)

    async def maps(self) -> Sequence[Map]:
        """All maps that can be opened, in the version that is served, by id."""
        return await asyncio.to_thread(self._maps.list)

    async def map(self, ref: str) -> Map:
        """One map: ``id``, or ``id@version``.

        Raises:
            VislocError: what the store raises.
        """
        return await asyncio.to_thread(self._maps.find, ref)

    def _check_ready(self) -> None:
        if not self._ready:
            raise Unavailable("server.starting", "the maps are being loaded; try again shortly")

    async def _run(self, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Work in a thread of the pool."""
        return await asyncio.wrap_future(self._pool.submit(work, *args, **kwargs))

    async def _look(
        self,
        targets: Sequence[Target],
        images: Sequence[ImageJob],
        options: LocalizeOptions,
        priors: Priors,
    ) -> list[tuple[SeenImage, ...]]:
        """Look at all images of an instant; the result is by target."""
        now = perf_counter()
        tasks = [
            asyncio.ensure_future(
                self._run(look_at, image, targets, options, priors, self._limits, now)
            )
            for image in images
        ]
        try:
            looks = await asyncio.gather(*tasks)
        finally:
            for task in tasks:
                task.cancel()  # when one refuses the request, nobody waits for the others
        return [tuple(look[i] for look in looks) for i in range(len(targets))]

    def _targets(self, maps: Sequence[str], rig: Rig | None) -> list[Target]:
        localizers = [self._maps.localizer(ref) for ref in maps]
        return [Target(found, rig_in_map(rig, found.map)) for found in localizers]

    def _localize(self, job: LocalizeJob, submitted: float) -> Localization:
        started = perf_counter()
        localizers = [self._maps.localizer(ref) for ref in job.maps]
        loaded = perf_counter()
        before = {"queued": started - submitted, "open_map": loaded - started}
        answers: list[Answer] = []
        if isinstance(job.query, QueryFeatures):
            answers = [
                localizer.localize_features(job.query, job.camera, job.options, job.priors)
                for localizer in localizers
            ]
        else:
            photo = read_photo(job.query, self._limits)
            before["decode"] = perf_counter() - loaded
            found: FeatureCache = {}
            answers = [
                localizer.localize(photo, job.camera, job.options, job.priors, found)
                for localizer in localizers
            ]
        best = max(
            range(len(answers)),
            key=lambda i: (isinstance(answers[i], Localized), answers[i].evidence.num_inliers),
        )
        answer, manifest = answers[best], localizers[best].map.manifest
        seconds = {**before, **answer.evidence.seconds}
        return Localization(
            replace(answer, evidence=replace(answer.evidence, seconds=seconds)),
            manifest.id,
            manifest.version,
        )


async def _one_by_one(instants: Sequence[Instant]) -> AsyncIterator[Instant]:
    for instant in instants:
        yield instant
