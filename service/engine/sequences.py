"""A sequence through maps, in the main process: one task after another for each instant."""

from __future__ import annotations

from collections.abc import AsyncGenerator, AsyncIterator, Sequence
from dataclasses import replace

from service.engine.instant_tasks import look, without_photos
from service.engine.sets import check_no_tiles
from service.values import InstantJob, Localization, MapFolder, SequenceJob
from service.workers.pool import Workers
from service.workers.tasks import Vision
from visloc.errors import VislocError
from visloc.priors import NO_PRIORS


async def answers_in_maps(
    workers: Workers,
    start: SequenceJob,
    instants: AsyncIterator[InstantJob] | Sequence[InstantJob],
    maps: tuple[MapFolder, ...],
) -> AsyncGenerator[Localization]:
    """Answer instants in order, each as soon as its answer is final.

    Arguments and errors are as in ``Engine.localize_sequence``.
    """
    sequence = await workers.run(Vision.open_sequence, start, maps)
    if isinstance(instants, Sequence):
        for instant in instants:
            check_no_tiles(maps, instant.priors or NO_PRIORS)
        bare = [replace(each, images=without_photos(each.images)) for each in instants]
        sequence, _ = await workers.run(Vision.check_instants, sequence, maps, 0, bare)
    index = 0
    try:
        async for instant in in_turn(instants):
            bare = [replace(instant, images=without_photos(instant.images))]
            sequence, (priors,) = await workers.run(
                Vision.check_instants, sequence, maps, index, bare
            )
            check_no_tiles(maps, priors)
            looks = await look(workers, maps, start.rig, instant.images, start.options, priors)
            step = await workers.run(Vision.add_instant, sequence, maps, bare[0], looks, priors)
            sequence = step.sequence
            maps = tuple(each for each in maps if each.ref in step.maps)
            for answer in step.answers:
                yield answer
            index += 1
    except VislocError:
        # An error of one instant does not discard the answers before it.
        if index > 0:
            for answer in await workers.run(Vision.finish_sequence, sequence, maps):
                yield answer
        raise
    for answer in await workers.run(Vision.finish_sequence, sequence, maps):
        yield answer


def in_turn(
    instants: AsyncIterator[InstantJob] | Sequence[InstantJob],
) -> AsyncIterator[InstantJob]:
    """Return an iterator over the instants of a list or a stream."""
    return _one_by_one(instants) if isinstance(instants, Sequence) else instants


async def _one_by_one(instants: Sequence[InstantJob]) -> AsyncGenerator[InstantJob]:
    for instant in instants:
        yield instant
