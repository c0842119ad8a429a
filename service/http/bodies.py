"""Reads the bodies of HTTP requests within limits and checks them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Collection, Mapping
from functools import partial
from typing import TypeVar

from python_multipart.multipart import parse_options_header
from starlette.requests import Request

from service.api import jobs
from service.api.parsing import ONE_BY_ONE
from service.http.envelope import backend_of
from service.http.forms import Form, FormLimits, parse_form
from service.settings import REQUEST_OVERHEAD_BYTES, ServiceSettings
from service.values import InstantJob, RigJob, SequenceJob
from visloc.errors import VislocError, refuse
from visloc_api.words.json_text import num_json_values
from visloc_api.words.maps import UseVersionRequest
from visloc_api.words.message import MAX_INSTANT_VALUES, MAX_JSON_VALUES
from visloc_api.words.photo import LocalizeRequest
from visloc_api.words.rigs import BatchLimits, LocalizeRigRequest
from visloc_api.words.sequences import LocalizeSequenceRequest

# The parts of the form of one photo that are files, and the file names in curl's examples.
_FILES_PER_IMAGE = 2  # a photo and its mask
_FILES = {"image": "photo.jpg", "features": "photo.json", "mask": "mask.png"}
# Bytes of JSON from which on it is parsed in the thread for long texts, whatever it holds.
_LARGE_BYTES = 2**20
_FORM, _JSON = "multipart/form-data", "application/json"
# Values in a sequence: each takes about a microsecond and 100 bytes to parse. A photo needs 16 for
# its pinhole camera and its share of the instant's. An instant of few photos needs more: odometry
# with its covariance, and a pose prior.
_VALUES_PER_IMAGE, _LEAST_PER_INSTANT = 16, 150
JobT = TypeVar("JobT")
# Function that makes a job from the JSON of a batch and the files that it names.
ToJob = Callable[[str | bytes, Mapping[str, bytes]], JobT]


async def parsed(text: str | bytes, parse: Callable[[], JobT]) -> JobT:
    """Parse JSON, not on the event loop; raises what ``parse`` raises."""
    if len(text) > _LARGE_BYTES or num_json_values(text) > MAX_JSON_VALUES:
        return await ONE_BY_ONE.run(parse, len(text))
    return await asyncio.to_thread(parse)


async def read_localize_job(request: Request) -> RigJob:
    """Read the body of ``POST /localize``, a form or JSON.

    Raises:
        TooLarge: ``request.too_large``, before the rest of the body is read.
        InvalidInput: ``request...``, or a code of the wrong field.
    """
    backend = backend_of(request)
    content_type = request.headers.get("content-type", "")

    def from_form(body: bytes) -> RigJob:
        form = parse_form(
            content_type,
            body,
            FormLimits(len(LocalizeRequest.model_fields), REQUEST_OVERHEAD_BYTES),
            expected="a form with a file image or features, and texts map, camera, options...",
            text_names=LocalizeRequest.model_fields.keys() - _FILES.keys(),
        )
        _check_kinds(form)
        return jobs.photo_job_of(LocalizeRequest.read({**form.texts, **form.files}))

    def from_json(body: bytes) -> RigJob:
        return jobs.photo_job_of(LocalizeRequest.read_json(body))

    if checked_media_type(request, (_FORM, _JSON)) == _FORM:
        async with backend.arrivals.body(request, backend.settings.max_request_bytes) as body:
            # Parsing takes milliseconds, too long for the event loop.
            return await asyncio.to_thread(from_form, body)
    async with backend.arrivals.body(request, backend.settings.max_json_bytes) as body:
        return await parsed(body, partial(from_json, body))


async def read_rig_job(request: Request) -> RigJob:
    """Read the body of ``POST /localize/rig``, a form or JSON.

    Raises:
        TooLarge: ``request.too_large``, before the rest of the body is read; ``rig.too_many_...``.
        InvalidInput: ``request...``, or a code of the wrong field.
    """
    settings = backend_of(request).settings
    limits = BatchLimits(settings.max_rig_images, settings.max_instants)

    def to_job(text: str | bytes, files: Mapping[str, bytes]) -> RigJob:
        return jobs.rig_job_of(
            LocalizeRigRequest.read_json(text, limits, MAX_INSTANT_VALUES), files
        )

    return await _read_batch(request, to_job, max_files=_FILES_PER_IMAGE * settings.max_rig_images)


async def read_sequence_jobs(request: Request) -> tuple[SequenceJob, list[InstantJob]]:
    """Read the body of ``POST /localize/sequence``, a form or JSON.

    Raises:
        TooLarge: ``request.too_large``, before the rest of the body is read;
            ``sequence.too_many_instants``, ``rig.too_many_...``.
        InvalidInput: ``request...``, or a code of the wrong field.
    """
    settings = backend_of(request).settings
    limits = BatchLimits(settings.max_rig_images, settings.max_instants)
    max_values = max_sequence_values(settings)

    def to_jobs(
        text: str | bytes, files: Mapping[str, bytes]
    ) -> tuple[SequenceJob, list[InstantJob]]:
        return jobs.sequence_jobs_of(
            LocalizeSequenceRequest.read_json(text, limits, max_values), files
        )

    max_files = _FILES_PER_IMAGE * settings.max_rig_images * settings.max_instants
    return await _read_batch(request, to_jobs, max_files=max_files)


def max_sequence_values(settings: ServiceSettings) -> int:
    """Return how many values the JSON of a sequence may have."""
    per_instant = max(_LEAST_PER_INSTANT, _VALUES_PER_IMAGE * (settings.max_rig_images + 1))
    return max(MAX_INSTANT_VALUES, per_instant * (settings.max_instants + 1))


async def read_use_version(request: Request) -> UseVersionRequest:
    """Read the body of ``POST /maps/{map_id}/current``.

    Raises:
        TooLarge: ``request.too_large``.
        InvalidInput: ``request...``.
    """
    checked_media_type(request, (_JSON,))
    async with backend_of(request).arrivals.body(request, REQUEST_OVERHEAD_BYTES) as body:
        return UseVersionRequest.read_json(body)


def checked_media_type(request: Request, kinds: Collection[str]) -> str:
    """Return the media type of the body.

    Raises:
        InvalidInput: ``request.content_type`` when it is none of ``kinds``, or JSON in another
            charset than UTF-8; ``request.content_encoding`` when the body is compressed.
    """
    encodings = ",".join(request.headers.getlist("content-encoding")).lower()
    if not {each.strip() for each in encodings.split(",")} <= {"", "identity"}:
        raise refuse("request.content_encoding", field="Content-Encoding", got=encodings[:100])
    name, options = parse_options_header(request.headers.get("content-type", ""))
    media_type = name.decode("latin-1").strip()
    charset = options.get(b"charset", b"utf-8").decode("latin-1").lower()
    if media_type.endswith("json") and charset not in ("utf-8", "utf8", "us-ascii"):
        raise refuse(
            "request.content_type",
            "JSON is read in UTF-8 only",
            field="Content-Type",
            expected="charset=utf-8, or no charset",
            got=charset[:100],
        )
    if media_type not in kinds:
        raise refuse(
            "request.content_type",
            field="Content-Type",
            expected=" or ".join(kinds),
            got=media_type or "none",
        )
    return media_type


async def _read_batch(request: Request, to_job: ToJob[JobT], *, max_files: int) -> JobT:
    """Read several photos: JSON, or a form with that JSON as ``request`` and a file per photo."""
    backend = backend_of(request)
    max_bytes = backend.settings.max_batch_bytes
    content_type = request.headers.get("content-type", "")

    def from_form(body: bytes) -> tuple[str, Mapping[str, bytes]]:
        form = parse_form(
            content_type,
            body,
            FormLimits(max_files + 1, max_text_bytes=max_bytes),
            expected=f"a form with a text request (JSON) and at most {max_files} files",
            text_names=("request",),
        )
        if form.texts.keys() != {"request"}:
            raise _no_request_text(form)
        return form.texts["request"], form.files

    is_form = checked_media_type(request, (_FORM, _JSON)) == _FORM
    async with backend.arrivals.body(request, max_bytes) as body:
        text, files = await asyncio.to_thread(from_form, body) if is_form else (body, {})
        return await parsed(text, partial(to_job, text, files))


def _no_request_text(form: Form) -> VislocError:
    name = next((name for name in form.texts if name != "request"), None)
    return refuse(
        "request.missing_field" if name is None else "request.unknown_field",
        "the form needs the request as a text part",
        field="request" if name is None else name[:100],
        expected="a text, as of curl -F 'request=<request.json'",
        got="a file" if name is None and "request" in form.files else name,
    )


def _check_kinds(form: Form) -> None:
    """Refuse texts that must be files, and files that must be texts.

    Raises:
        InvalidInput: ``request.invalid``.
    """
    # Features are JSON, which is text.
    for name in form.texts.keys() & (_FILES.keys() - {"features"}):
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
