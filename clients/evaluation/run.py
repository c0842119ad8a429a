"""Asking about many photos, several at a time."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Iterable
from dataclasses import dataclass
from typing import TypeVar

from clients.client import AsyncClient
from clients.errors import not_understood
from clients.evaluation.filling import photo_result, poses_from_rig
from clients.evaluation.instants import QueryInstant
from clients.evaluation.queries import Query
from clients.wire.answers import parse_answer
from clients.wire.features import Features
from clients.wire.rigs import InstantResult, RigImage
from clients.wire.types import LocalizeOptions, LocalizeResult
from visloc.errors import InvalidInput, Overloaded, VislocError, WeightsError
from visloc.sequences.filling import TracedPose

_T = TypeVar("_T")

# After these waits a server that is still overloaded ends the run.
_RETRY_AFTER_S = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
# What may go wrong with one photo while the others are fine ...
_CODES_OF_ONE_PHOTO = ("server.internal", "server.timeout")
# ... and what would be refused with every photo.
_CODES_OF_ALL_PHOTOS = ("options.", "map.", "rig.", "features.required", "features.kind")


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What became of one photo: a result, or the error that concerns this photo only.

    Attributes:
        query: the photo.
        result: the answer, localized or not.
        error: why there is no answer.
        seconds: from sending to the parsed answer, as the caller sees it, including waits for an
            overloaded server.
        filled: the pose that the other cameras of its rig give a photo without one of its own.
    """

    query: Query
    result: LocalizeResult | None
    error: VislocError | None
    seconds: float
    filled: TracedPose | None = None


@dataclass(frozen=True, slots=True, eq=False)
class InstantOutcome:
    """What became of the photos of one instant.

    Attributes:
        photos: what became of each, in the order of the instant; their seconds are the instant's.
        localized: whether the instant has a pose of its own.
        has_answer: whether the server said anything.
        seconds: as of ``Outcome``.
    """

    photos: tuple[Outcome, ...]
    localized: bool
    has_answer: bool
    seconds: float


async def localize_all(
    client: AsyncClient,
    queries: Iterable[Query],
    map_ref: str,
    options: LocalizeOptions,
    concurrency: int,
    on_outcome: Callable[[Outcome], None],
    read: Callable[[Query], bytes | Features],
) -> None:
    """Localize photos, ``concurrency`` at a time, and report each one as it is done.

    ``read`` gives what is sent of a photo: the photo, or its features.

    A photo that cannot be read, or that the server refuses or fails on, fails alone. Cancelling
    abandons the photos under way; those reported are done.

    Raises:
        VislocError: what makes going on pointless, such as a server that is gone.
    """

    async def work(query: Query) -> None:
        on_outcome(await localize_one(client, query, map_ref, options, read))

    await _work_through(queries, concurrency, work)


async def localize_one(
    client: AsyncClient,
    query: Query,
    map_ref: str,
    options: LocalizeOptions,
    read: Callable[[Query], bytes | Features],
) -> Outcome:
    """Localize one photo, as ``localize_all`` does.

    Raises:
        VislocError: what would be refused with every photo, or makes going on pointless.
    """
    started = time.perf_counter()
    try:
        sent = await asyncio.to_thread(read, query)
        started = time.perf_counter()
        result = await _ask_patiently(lambda: client.localize(sent, map_ref, query.camera, options))
    except VislocError as error:
        _raise_unless_of_one(error)
        return Outcome(query, None, error, time.perf_counter() - started)
    return Outcome(query, result, None, time.perf_counter() - started)


async def localize_instants(
    client: AsyncClient,
    instants: Iterable[QueryInstant],
    map_ref: str,
    options: LocalizeOptions,
    concurrency: int,
    on_outcome: Callable[[InstantOutcome], None],
    read: Callable[[Query], bytes | Features],
) -> None:
    """Localize instants as ``localize_all`` does photos.

    Of an instant, photos that cannot be read fail alone, and the others are asked about. Those
    that contributed nothing to the pose of their rig, by an error or without one, are filled.

    Raises:
        VislocError: what makes going on pointless, such as a server that is gone.
    """

    async def work(instant: QueryInstant) -> None:
        images: dict[str, RigImage] = {}
        errors: dict[str, VislocError] = {}
        for query in instant.photos:
            try:
                sent = await asyncio.to_thread(read, query)
            except VislocError as error:
                _raise_unless_of_one(error)
                errors[query.name] = error
            else:
                images[query.name] = RigImage(query.sensor, sent, query.camera, query.timestamp)
        started = time.perf_counter()
        result = None
        try:
            if images:
                result = await _ask_patiently(
                    lambda: client.localize_rig(images.values(), map_ref, instant.rig, options)
                )
        except VislocError as error:
            _raise_unless_of_one(error)
            errors |= dict.fromkeys(images, error)
        seconds = time.perf_counter() - started
        results: dict[str, LocalizeResult] = {}
        filled: dict[str, TracedPose] = {}
        if result is not None:
            _take_answer(client.server, result, images, results, errors)
            filled = parse_answer(client.server, poses_from_rig, result, instant.rig)
        photos = tuple(
            Outcome(
                *(query, results.get(query.name), errors.get(query.name), seconds),
                filled.get(query.sensor),
            )
            for query in instant.photos
        )
        localized = result is not None and result.localized
        on_outcome(InstantOutcome(photos, localized, result is not None, seconds))

    await _work_through(instants, concurrency, work)


def _take_answer(
    server: str,
    result: InstantResult,
    images: dict[str, RigImage],
    results: dict[str, LocalizeResult],
    errors: dict[str, VislocError],
) -> None:
    """Sort the answers to the photos of an instant, by name, into results and errors."""
    answered = [image.sensor for image in result.images]
    if answered != [image.sensor for image in images.values()]:
        raise not_understood(server, f"answers to photos of {', '.join(answered)}"[:200])
    for index, (name, image) in enumerate(zip(images, result.images, strict=True)):
        if image.error is not None:
            errors[name] = image.error
        else:
            results[name] = parse_answer(server, photo_result, result, index)


async def _work_through(
    items: Iterable[_T], concurrency: int, work: Callable[[_T], Awaitable[None]]
) -> None:
    waiting = iter(items)

    async def take() -> None:
        for item in waiting:
            await work(item)

    try:
        async with asyncio.TaskGroup() as group:
            for _ in range(concurrency):
                group.create_task(take())
    except ExceptionGroup as failed:
        raise failed.exceptions[0] from None


def _raise_unless_of_one(error: VislocError) -> None:
    """Raise what does not concern one photo or instant only."""
    if isinstance(error, InvalidInput) and not isinstance(error, WeightsError):
        is_of_one = not error.code.startswith(_CODES_OF_ALL_PHOTOS)
    else:
        is_of_one = error.code in _CODES_OF_ONE_PHOTO
    if not is_of_one:
        raise error


async def _ask_patiently(ask: Callable[[], Awaitable[_T]]) -> _T:
    for wait_s in _RETRY_AFTER_S:
        try:
            return await ask()
        except Overloaded:
            await asyncio.sleep(wait_s)
    return await ask()
