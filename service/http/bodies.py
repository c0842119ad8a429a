"""Bodies of HTTP requests, read within limits and checked."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Callable, Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from time import monotonic, sleep
from typing import TypeVar

from starlette.datastructures import Headers, UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser
from starlette.requests import Request

from service.api import (
    BatchLimits,
    LocalizeRequest,
    LocalizeRigRequest,
    LocalizeSequenceRequest,
    UseVersionRequest,
)
from service.api.message import MAX_INSTANT_VALUES
from service.http.slow_clients import arrivals_of
from service.settings import REQUEST_OVERHEAD_BYTES, ServiceSettings
from service.values import Instant, LocalizeJob, RigJob, SequenceStart
from visloc.errors import refuse

_CHUNK_BYTES = 64 * 1024
# The parts of the form of one photo that are files, and how curl sends them.
_FILES = {"image": "photo.jpg", "features": "photo.json"}
_FORM = "multipart/form-data"
_KINDS = (_FORM, "application/json")
JobT = TypeVar("JobT")


class _BatchParser:
    """Parses the JSON of batches in a thread, one after the other.

    Parsing keeps Python's lock, for some tenths of a second for the largest sequence. An answer to
    anybody else takes several turns of the event loop, each of which would wait for one more
    batch. So the thread rests after each for as long as it took.
    """

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="batches")
        self._rests_until = 0.0

    async def parse(
        self,
        to_job: Callable[[str | bytes, Mapping[str, bytes]], JobT],
        text: str | bytes,
        files: Mapping[str, bytes],
    ) -> JobT:
        """Make the job of a batch; errors are those of ``to_job``."""
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._thread, self._parsed, to_job, text, files)

    def _parsed(
        self,
        to_job: Callable[[str | bytes, Mapping[str, bytes]], JobT],
        text: str | bytes,
        files: Mapping[str, bytes],
    ) -> JobT:
        started = monotonic()
        if started < self._rests_until:
            sleep(self._rests_until - started)
            started = monotonic()
        try:
            return to_job(text, files)
        finally:
            ended = monotonic()
            self._rests_until = ended + (ended - started)


_BATCHES = _BatchParser()


@dataclass(frozen=True, slots=True)
class _Form:
    texts: dict[str, str] = field(default_factory=dict)
    files: dict[str, bytes] = field(default_factory=dict)


async def read_localize_job(request: Request, settings: ServiceSettings) -> LocalizeJob:
    """Read the body of ``POST /localize``, as a form or as JSON.

    Raises:
        TooLarge: ``request.too_large``, before the rest of the body is read.
        InvalidInput: ``request...``, or a code of the field that is wrong.
    """

    def from_form(body: bytes) -> LocalizeJob:
        form = _parse_form(
            request.headers,
            body,
            max_files=len(_FILES),
            max_texts=len(LocalizeRequest.model_fields),
            max_text_bytes=REQUEST_OVERHEAD_BYTES,
            expected="a form with a file image or features, and texts map, camera, options...",
        )
        _check_kinds(form)
        return LocalizeRequest.read({**form.texts, **form.files}).to_job()

    return await _read(
        request,
        from_form=(from_form, settings.max_request_bytes),
        from_json=(
            lambda body: LocalizeRequest.read_json(body).to_job(),
            settings.max_json_bytes,
        ),
    )


async def read_rig_job(request: Request, settings: ServiceSettings) -> RigJob:
    """Read the body of ``POST /localize/rig``, as a form or as JSON.

    Raises:
        TooLarge: ``request.too_large``, before the rest of the body is read; ``rig.too_many_...``.
        InvalidInput: ``request...``, or a code of the field that is wrong.
    """
    limits = _limits(settings)

    def job(text: str | bytes, files: Mapping[str, bytes]) -> RigJob:
        read = LocalizeRigRequest.read_json(text, limits, MAX_INSTANT_VALUES)
        return read.to_job(files)

    return await _read_batch(request, settings, job, max_files=settings.max_rig_images)


async def read_sequence_jobs(
    request: Request, settings: ServiceSettings
) -> tuple[SequenceStart, list[Instant]]:
    """Read the body of ``POST /localize/sequence``, as a form or as JSON.

    Raises:
        TooLarge: ``request.too_large``, before the rest of the body is read;
            ``sequence.too_many_instants``, ``rig.too_many_...``.
        InvalidInput: ``request...``, or a code of the field that is wrong.
    """
    limits = _limits(settings)

    def jobs(text: str | bytes, files: Mapping[str, bytes]) -> tuple[SequenceStart, list[Instant]]:
        read = LocalizeSequenceRequest.read_json(text, limits, settings.max_sequence_values)
        return read.to_jobs(files)

    max_files = settings.max_rig_images * settings.max_instants
    return await _read_batch(request, settings, jobs, max_files=max_files)


async def read_use_version(request: Request) -> UseVersionRequest:
    """Read the body of ``POST /maps/{map_id}/current``.

    Raises:
        TooLarge: ``request.too_large``.
        InvalidInput: ``request...``.
    """
    checked_media_type(request, ("application/json",))
    async with arrivals_of(request).body(request, REQUEST_OVERHEAD_BYTES) as body:
        return UseVersionRequest.read_json(body)


def checked_media_type(request: Request, kinds: Collection[str]) -> str:
    """Return what kind of body it is.

    Raises:
        InvalidInput: ``request.content_type`` when it is none of ``kinds``.
    """
    media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media_type not in kinds:
        raise refuse(
            "request.content_type",
            field="Content-Type",
            expected=" or ".join(kinds),
            got=media_type or "none",
        )
    return media_type


def _limits(settings: ServiceSettings) -> BatchLimits:
    return BatchLimits(settings.max_rig_images, settings.max_instants)


async def _read_batch(
    request: Request,
    settings: ServiceSettings,
    to_job: Callable[[str | bytes, Mapping[str, bytes]], JobT],
    *,
    max_files: int,
) -> JobT:
    """Read several photos: JSON, or a form with that JSON as ``request`` and a file per photo."""

    def from_form(body: bytes) -> tuple[str, Mapping[str, bytes]]:
        expected = f"a form with a text request (JSON) and at most {max_files} files"
        form = _parse_form(
            request.headers,
            body,
            max_files=max_files,
            max_texts=1,
            max_text_bytes=settings.max_batch_bytes,
            expected=expected,
        )
        if form.texts.keys() != {"request"}:
            name = next(iter(form.texts), None)
            raise refuse(
                "request.missing_field" if name is None else "request.unknown_field",
                "the form needs the request as a text part",
                field="request" if name is None else name[:100],
                expected="a text, as of curl -F 'request=<request.json'",
                got="a file" if name is None and "request" in form.files else name,
            )
        return form.texts["request"], form.files

    is_form = checked_media_type(request, _KINDS) == _FORM
    async with arrivals_of(request).body(request, settings.max_batch_bytes) as body:
        text, files = await asyncio.to_thread(from_form, body) if is_form else (body, {})
        return await _BATCHES.parse(to_job, text, files)


async def _read(
    request: Request,
    *,
    from_form: tuple[Callable[[bytes], JobT], int],
    from_json: tuple[Callable[[bytes], JobT], int],
) -> JobT:
    """Read a body of either kind, each with its largest number of bytes."""
    is_form = checked_media_type(request, _KINDS) == _FORM
    parse, limit = from_form if is_form else from_json
    async with arrivals_of(request).body(request, limit) as body:
        # Photos and features take milliseconds to parse and decode: off the event loop with them.
        return await asyncio.to_thread(parse, body)


def _parse_form(
    headers: Headers,
    body: bytes,
    *,
    max_files: int,
    max_texts: int,
    max_text_bytes: int,
    expected: str,
) -> _Form:
    """Take a form apart. This runs in a thread of its own: 20 MB take half a second.

    Raises:
        InvalidInput: ``request.malformed`` or ``request.duplicate_field``.
    """

    async def stream() -> AsyncGenerator[bytes, None]:
        for start in range(0, len(body), _CHUNK_BYTES):
            yield body[start : start + _CHUNK_BYTES]

    async def parse() -> _Form:
        parser = MultiPartParser(
            headers,
            stream(),
            max_files=max_files,
            max_fields=max_texts,
            max_part_size=max_text_bytes,
        )
        parser.spool_max_size = len(body) + 1  # files stay in memory, none on disk
        parsed = await parser.parse()
        form = _Form()
        try:
            for name, value in parsed.multi_items():
                if name in form.texts or name in form.files:
                    raise refuse("request.duplicate_field", field=name[:100])
                if isinstance(value, UploadFile):
                    form.files[name] = await value.read()
                else:
                    form.texts[name] = value
        finally:
            await parsed.close()
        return form

    try:
        return asyncio.run(parse())
    except MultiPartException as error:
        raise refuse("request.malformed", error.message, expected=expected) from None


def _check_kinds(form: _Form) -> None:
    """Refuse texts that must be files, and the other way round.

    Raises:
        InvalidInput: ``request.invalid``.
    """
    for name in form.texts.keys() & _FILES.keys():
        raise refuse(
            "request.invalid",
            "the form has the wrong kind of part here",
            field=name,
            expected=f"a file, as of curl -F {name}=@{_FILES[name]}",
        )
    for name in form.files.keys() & (LocalizeRequest.model_fields.keys() - _FILES.keys()):
        raise refuse(
            "request.invalid",
            "the form has the wrong kind of part here",
            field=name,
            expected="a text, without a file name",
        )
