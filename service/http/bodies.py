"""Reads the bodies of HTTP requests within limits and checks them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

from python_multipart import FormParser
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import Field, File, parse_options_header
from starlette.requests import Request

from service.api import jobs
from service.api.parsing import ONE_BY_ONE
from service.http.envelope import backend_of
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
# Longer than the longest boundary and the line ends that some clients send before it.
_BEGINNING = 1024
# The body is in memory already: its parts need no temporary files.
_PARSER_CONFIG = {"MAX_MEMORY_FILE_SIZE": float("inf"), "UPLOAD_ERROR_ON_BAD_CTE": True}
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
    """Read the body of ``POST /localize``, a form or JSON."""
    backend = backend_of(request)
    content_type = request.headers.get("content-type", "")

    def from_form(body: bytes) -> RigJob:
        form = parse_form(
            content_type,
            body,
            max_parts=len(LocalizeRequest.model_fields),
            max_text_bytes=REQUEST_OVERHEAD_BYTES,
            text_names=LocalizeRequest.model_fields.keys() - _FILES.keys(),
            expected="a form with a file image or features, and texts map, camera, options...",
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
    """Read the body of ``POST /localize/rig``, a form or JSON."""
    settings = backend_of(request).settings
    limits = BatchLimits(settings.max_rig_images, settings.max_instants)

    def to_job(text: str | bytes, files: Mapping[str, bytes]) -> RigJob:
        return jobs.rig_job_of(
            LocalizeRigRequest.read_json(text, limits, MAX_INSTANT_VALUES), files
        )

    return await _read_batch(request, to_job, max_files=_FILES_PER_IMAGE * settings.max_rig_images)


async def read_sequence_jobs(request: Request) -> tuple[SequenceJob, list[InstantJob]]:
    """Read the body of ``POST /localize/sequence``, a form or JSON."""
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
    """Read the body of ``POST /maps/{map_id}/current``."""
    checked_media_type(request, (_JSON,))
    async with backend_of(request).arrivals.body(request, REQUEST_OVERHEAD_BYTES) as body:
        return UseVersionRequest.read_json(body)


def checked_media_type(request: Request, kinds: Collection[str]) -> str:
    """Return the media type of the body."""
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


@dataclass(frozen=True, slots=True)
class Form:
    """The parts of a form by name.

    A part with a file name is a file. One without is a text if its name says so or its bytes are
    text, and a file otherwise: some clients send bytes without a file name.
    """

    texts: Mapping[str, str]
    files: Mapping[str, bytes]


def parse_form(
    content_type: str,
    body: bytes,
    *,
    max_parts: int,
    max_text_bytes: int,
    text_names: Collection[str],
    expected: str,
) -> Form:
    """Parse a whole form. This blocks: 20 MB take 0.05 s.

    Args:
        max_text_bytes: of each part of ``text_names``.
        text_names: the parts that are texts unless they have a file name.
    """
    _, options = parse_options_header(content_type)
    charset = options.get(b"charset", b"utf-8").decode("latin-1")
    texts: dict[str, str] = {}
    files: dict[str, bytes] = {}
    ended: list[bool] = []

    def malformed(message: str, field: str | None = None) -> VislocError:
        return refuse("request.malformed", message, field=field, expected=expected)

    def add(part: Field | File) -> None:
        name = _decoded(part.field_name or b"", charset)
        if name in texts or name in files:
            raise refuse("request.duplicate_field", field=name[:100])
        if len(texts) + len(files) == max_parts:
            raise malformed(f"the form has more than {max_parts} parts", name[:100])
        if isinstance(part, File):
            part.file_object.seek(0)
            files[name] = part.file_object.read()
            return
        value = part.value or b""
        if name in text_names and len(value) > max_text_bytes:
            raise malformed(f"the text has more than {max_text_bytes} bytes", name)
        if name in text_names or _is_utf8(value):
            texts[name] = _decoded(value, charset)
        else:
            files[name] = value

    boundary = options.get(b"boundary", b"")
    if not boundary:
        raise malformed("Content-Type names no boundary of multipart data")
    # The parser would skip what stands between a line end and the first hyphen.
    if not body[:_BEGINNING].lstrip(b"\r\n").startswith(b"--" + boundary):
        raise malformed("the body does not begin with the boundary that Content-Type names")
    delimiter = b"\r\n--" + boundary
    closing = body.find(delimiter + b"--")
    if closing >= 0 and body.find(delimiter, closing + 1) >= 0:
        raise malformed("the form has parts after its closing boundary")
    try:
        parser = FormParser(
            _FORM, add, add, lambda: ended.append(True), boundary, config=_PARSER_CONFIG
        )
        parser.write(body)
    except FormParserError as error:
        raise malformed(f"no multipart data: {error}") from None
    # What has been read of a form that was cut may be a whole form of fewer parts.
    if not ended:
        raise malformed("the form is cut: its closing boundary is missing")
    return Form(texts, files)


def _decoded(data: bytes, charset: str) -> str:
    try:
        return data.decode(charset)
    except (UnicodeError, LookupError):
        return data.decode("latin-1")


def _is_utf8(data: bytes) -> bool:
    """Tell whether bytes are text in UTF-8, which has no zeros."""
    try:
        data.decode()
    except UnicodeDecodeError:
        return False
    return b"\0" not in data


async def _read_batch(request: Request, to_job: ToJob[JobT], *, max_files: int) -> JobT:
    """Read several photos: JSON, or a form with that JSON as ``request`` and a file per photo."""
    backend = backend_of(request)
    max_bytes = backend.settings.max_batch_bytes
    content_type = request.headers.get("content-type", "")

    def from_form(body: bytes) -> tuple[str, Mapping[str, bytes]]:
        form = parse_form(
            content_type,
            body,
            max_parts=max_files + 1,
            max_text_bytes=max_bytes,
            text_names=("request",),
            expected=f"a form with a text request (JSON) and at most {max_files} files",
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
    """Refuse texts that must be files, and files that must be texts."""
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
