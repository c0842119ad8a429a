"""The tasks that localize the images of one instant in maps."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine, Iterable, Sequence
from dataclasses import replace
from time import time
from typing import Any, TypeVar

from service.values import ImageJob, Localization, MapFolder, PackedLooks, Rig, RigJob
from service.workers.pool import Workers
from service.workers.tasks import Vision
from visloc.options import LocalizeOptions
from visloc.priors import Priors


async def localize_in(workers: Workers, job: RigJob, maps: tuple[MapFolder, ...]) -> Localization:
    """Localize a photo in one task; a rig with a task for each image, and one for all together.

    An image of a rig that cannot be used fails alone.
    """
    if job.rig is None:
        return await workers.run(Vision.localize, job, maps, time())
    bare, looks = await check_and_look(workers, job, maps)
    return await workers.run(Vision.solve_rig, bare, maps, looks)


async def check_and_look(
    workers: Workers, job: RigJob, maps: tuple[MapFolder, ...]
) -> tuple[RigJob, list[PackedLooks]]:
    """Check an instant, then look at all its images; return it without them, and the looks."""
    bare = replace(job, images=without_photos(job.images))
    await workers.run(Vision.check_rig, bare, maps)
    return bare, await look(workers, maps, job.rig, job.images, job.options, job.priors)


async def look(
    workers: Workers,
    maps: Sequence[MapFolder],
    rig: Rig | None,
    images: Sequence[ImageJob],
    options: LocalizeOptions,
    priors: Priors,
) -> list[PackedLooks]:
    """Look at all images of an instant, concurrently."""
    now = time()
    return await together(
        workers.run(Vision.look_at_image, image, maps, rig, options, priors, now)
        for image in images
    )


def without_photos(images: Sequence[ImageJob]) -> tuple[ImageJob, ...]:
    """Return images for checks that do not need their photos."""
    return tuple(replace(image, query=b"") for image in images)


T = TypeVar("T")


async def together(work: Iterable[Coroutine[Any, Any, T]]) -> list[T]:
    """Run coroutines concurrently, and return their results in order."""
    tasks = [asyncio.ensure_future(each) for each in work]
    try:
        return await asyncio.gather(*tasks)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
