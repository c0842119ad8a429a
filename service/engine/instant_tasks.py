"""What the main process has workers do about the images of an instant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from time import time

from service.engine.gather import together
from service.values import ImageJob, Instant, InstantLocalization, Rig, RigJob
from service.workers import process as worker
from service.workers.pool import Workers
from service.workers.process import MapFolder, Seen
from visloc.priors import Priors
from visloc.types import LocalizeOptions


async def solve_rig(
    workers: Workers, job: RigJob, maps: tuple[MapFolder, ...]
) -> InstantLocalization:
    """Localize the images of one instant together; one that cannot be used fails alone.

    Raises:
        InvalidInput: ``rig.*``, ``options.*``, ``priors.*``.
        Unavailable: ``server.worker_died``.
    """
    bare = replace(job, images=tuple(without_photo(image) for image in job.images))
    await workers.run(worker.check_rig, bare, maps)
    seen = await look(workers, maps, job.rig, job.images, job.options, job.priors)
    return await workers.run(worker.solve_rig, bare, maps, seen)


async def look(
    workers: Workers,
    maps: Sequence[MapFolder],
    rig: Rig | None,
    images: Sequence[ImageJob],
    options: LocalizeOptions,
    priors: Priors,
) -> list[Seen]:
    """Look at all images of an instant."""
    now = time()
    return await together(
        workers.run(worker.look_at_image, image, maps, rig, options, priors, now)
        for image in images
    )


def without_photo(image: ImageJob) -> ImageJob:
    """Return an image as far as it is checked."""
    return replace(image, query=b"")


def without_photos(instant: Instant) -> Instant:
    """Return an instant as far as it is checked."""
    return replace(instant, images=tuple(without_photo(image) for image in instant.images))
