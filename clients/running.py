"""Asking about many photos, several at a time."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from clients.client import AsyncClient
from clients.features import Features
from clients.queries import Query
from clients.types import LocalizeOptions, LocalizeResult
from visloc.errors import InvalidInput, Overloaded, VislocError, WeightsError

# After these waits a server that is still overloaded ends the run.
_RETRY_AFTER_S = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
# What may go wrong with one photo while the others are fine ...
_CODES_OF_ONE_PHOTO = ("server.internal", "server.timeout")
# ... and what would be refused with every photo.
_CODES_OF_ALL_PHOTOS = ("options.", "map.", "features.required", "features.kind")


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What became of one photo: a result, or the error that concerns this photo only.

    Attributes:
        query: the photo.
        result: the answer, localized or not.
        error: why there is no answer.
        seconds: from sending to the parsed answer, as the caller sees it, including waits for an
            overloaded server.
    """

    query: Query
    result: LocalizeResult | None
    error: VislocError | None
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
    waiting = iter(queries)

    async def work() -> None:
        for query in waiting:
            on_outcome(await _localize(client, query, map_ref, options, read))

    try:
        async with asyncio.TaskGroup() as group:
            for _ in range(concurrency):
                group.create_task(work())
    except ExceptionGroup as failed:
        raise failed.exceptions[0] from None


async def _localize(
    client: AsyncClient,
    query: Query,
    map_ref: str,
    options: LocalizeOptions,
    read: Callable[[Query], bytes | Features],
) -> Outcome:
    started = time.perf_counter()
    try:
        sent = await asyncio.to_thread(read, query)
        started = time.perf_counter()
        result = await _ask_patiently(client, sent, query, map_ref, options)
    except VislocError as error:
        if not _concerns_one_photo(error):
            raise
        return Outcome(query, None, error, time.perf_counter() - started)
    return Outcome(query, result, None, time.perf_counter() - started)


def _concerns_one_photo(error: VislocError) -> bool:
    if isinstance(error, InvalidInput) and not isinstance(error, WeightsError):
        return not error.code.startswith(_CODES_OF_ALL_PHOTOS)
    return error.code in _CODES_OF_ONE_PHOTO


async def _ask_patiently(
    client: AsyncClient,
    sent: bytes | Features,
    query: Query,
    map_ref: str,
    options: LocalizeOptions,
) -> LocalizeResult:
    for wait_s in _RETRY_AFTER_S:
        try:
            return await client.localize(sent, map_ref, query.camera, options)
        except Overloaded:
            await asyncio.sleep(wait_s)
    return await client.localize(sent, map_ref, query.camera, options)
