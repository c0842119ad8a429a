"""Localizing many photos, several at a time."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

from clients.client import AsyncClient
from clients.errors import not_understood
from clients.evaluation.filling import photo_result, poses_from_rig
from clients.evaluation.instants import QueryInstant
from clients.evaluation.queries import Query
from clients.evaluation.readers import Reader
from clients.wire.answers import InstantResult, LocalizeResult, parse_answer
from clients.wire.rigs import RigImage
from visloc.errors import InvalidInput, Overloaded, VislocError, WeightsError, refuse
from visloc.sequences.filling import TracedPose
from visloc_api.words.options import LocalizeOptions

_T = TypeVar("_T")
_R = TypeVar("_R")

# A server that is still overloaded after these waits ends the run.
_RETRY_AFTER_S = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
# Errors that concern one photo while the others may be fine.
_CODES_OF_ONE_PHOTO = ("server.internal", "server.timeout")
# Errors that every photo would get.
_CODES_OF_ALL_PHOTOS = ("options.", "map.", "rig.", "features.required", "features.kind")
# Of pairs, which each photo has of its own: they name a photo that the map lacks, or too many.
_CODE_OF_PAIRS = "options.photos"


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """The result of one photo, or the error that concerns this photo only.

    Attributes:
        result: the answer, localized or not.
        seconds: from sending to the parsed answer, including waits for an overloaded server.
        filled: the pose that the other cameras of its rig give a photo without one of its own.
    """

    query: Query
    result: LocalizeResult | None
    error: VislocError | None
    seconds: float
    filled: TracedPose | None = None

    @property
    def photos(self) -> tuple[Outcome, ...]:
        """Itself, as an ``InstantOutcome`` has several."""
        return (self,)

    @property
    def has_answer(self) -> bool:
        return self.result is not None


@dataclass(frozen=True, slots=True, eq=False)
class InstantOutcome:
    """The results of the photos of one instant.

    Attributes:
        photos: in the order of the instant; their seconds are the instant's.
        localized: whether the instant has a pose of its own.
        seconds: as for ``Outcome``.
    """

    photos: tuple[Outcome, ...]
    localized: bool
    has_answer: bool
    seconds: float


@dataclass(frozen=True, slots=True, eq=False)
class QueryClient:
    """A client, and what all queries of a run share.

    Attributes:
        read: reads what is sent for a photo: its bytes or its features.
        pairs: names of the mapping photos by the photo's name; None when the server retrieves them.
    """

    client: AsyncClient
    map_ref: str
    options: LocalizeOptions
    read: Reader
    pairs: Mapping[str, tuple[str, ...]] | None = None

    async def localize(self, query: Query) -> Outcome:
        """Localize one photo.

        A photo that cannot be read, or that the server refuses or fails on, fails alone.
        """
        started = time.perf_counter()
        try:
            options = self._options([query])
            sent = await asyncio.to_thread(self.read, query)
            started = time.perf_counter()
            result = await ask_patiently(
                lambda: self.client.localize(sent, self.map_ref, query.camera, options)
            )
        except VislocError as error:
            self._raise_unless_of_one(error)
            return Outcome(query, None, error, time.perf_counter() - started)
        return Outcome(query, result, None, time.perf_counter() - started)

    async def localize_instant(self, instant: QueryInstant) -> InstantOutcome:
        """Localize the photos of one instant together.

        Photos that cannot be read fail alone, and the others are sent. Photos that contribute
        nothing to the pose of their rig, by an error or without one, are filled.
        """
        images, errors = await self._read_images(instant)
        started = time.perf_counter()
        result = None
        try:
            if images:
                options = self._options(instant.photos)
                result = await ask_patiently(
                    lambda: self.client.localize_rig(
                        images.values(), self.map_ref, instant.rig, options
                    )
                )
        except VislocError as error:
            self._raise_unless_of_one(error)
            errors |= dict.fromkeys(images, error)
        seconds = time.perf_counter() - started
        results: dict[str, LocalizeResult] = {}
        filled: dict[str, TracedPose] = {}
        if result is not None:
            server = self.client.server
            _take_answer(server, result, images, results, errors)
            filled = parse_answer(server, poses_from_rig, result, instant.rig)
        photos = tuple(
            Outcome(
                *(query, results.get(query.name), errors.get(query.name), seconds),
                filled.get(query.sensor),
            )
            for query in instant.photos
        )
        localized = result is not None and result.localized
        return InstantOutcome(photos, localized, result is not None, seconds)

    def _options(self, queries: Sequence[Query]) -> LocalizeOptions:
        if self.pairs is None:
            return self.options
        photos = dict.fromkeys(name for each in queries for name in self.pairs.get(each.name, ()))
        if not photos:
            raise refuse("pairs.no_photo", field=queries[0].name)
        return LocalizeOptions(**self.options.given() | {"photos": list(photos)})

    def _raise_unless_of_one(self, error: VislocError) -> None:
        """Raise an error that does not concern one photo or instant only."""
        if self.pairs is not None and error.code == _CODE_OF_PAIRS:
            return
        raise_unless_of_one(error)

    async def _read_images(
        self, instant: QueryInstant
    ) -> tuple[dict[str, RigImage], dict[str, VislocError]]:
        """Return what is sent, and the errors of the photos that cannot be read, both by name."""
        images: dict[str, RigImage] = {}
        errors: dict[str, VislocError] = {}
        for query in instant.photos:
            try:
                sent = await asyncio.to_thread(self.read, query)
            except VislocError as error:
                self._raise_unless_of_one(error)
                errors[query.name] = error
            else:
                images[query.name] = RigImage(query.sensor, sent, query.camera, query.timestamp)
        return images, errors


async def localize_all(
    items: Iterable[_T],
    localize: Callable[[_T], Awaitable[_R]],
    concurrency: int,
    on_outcome: Callable[[_R], None],
) -> None:
    """Localize photos or instants, ``concurrency`` at a time, and report each one when it is done.

    Cancelling abandons the items under way; those reported are done.
    """
    waiting = iter(items)

    async def take() -> None:
        for item in waiting:
            on_outcome(await localize(item))

    try:
        async with asyncio.TaskGroup() as group:
            for _ in range(concurrency):
                group.create_task(take())
    except ExceptionGroup as failed:  # callers handle the error itself, not the group around it
        raise failed.exceptions[0] from None


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


def raise_unless_of_one(error: VislocError) -> None:
    """Raise an error that does not concern one photo or instant only."""
    if isinstance(error, InvalidInput) and not isinstance(error, WeightsError):
        is_of_one = not error.code.startswith(_CODES_OF_ALL_PHOTOS)
    else:
        is_of_one = error.code in _CODES_OF_ONE_PHOTO
    if not is_of_one:
        raise error


async def ask_patiently(ask: Callable[[], Awaitable[_T]]) -> _T:
    """Ask again, after waits, while the server is overloaded."""
    for wait_s in _RETRY_AFTER_S:
        try:
            return await ask()
        except Overloaded:
            await asyncio.sleep(wait_s)
    return await ask()
