"""Bodies of HTTP requests, read within limits and checked."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator

from starlette.datastructures import Headers, UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser
from starlette.requests import Request

from service.engine import LocalizeJob
from service.schemas import LocalizeRequest
from service.settings import REQUEST_OVERHEAD_BYTES, ServiceSettings
from visloc.errors import InvalidInput, TooLarge

_CHUNK_BYTES = 64 * 1024
# The parts of a form that are files, and how curl sends them.
_FILES = {"image": "photo.jpg", "features": "photo.json"}


async def read_localize_job(request: Request, settings: ServiceSettings) -> LocalizeJob:
    """Read the body of ``POST /localize``, as a form or as JSON.

    Raises:
        TooLarge: ``request.too_large``, before the rest of the body is read.
        InvalidInput: ``request...``, or a code of the field that is wrong.
    """
    media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    # Photos and features take milliseconds to parse and decode: off the event loop with them.
    if media_type == "multipart/form-data":
        body = await _read_body(request, settings.max_request_bytes)
        fields = await _read_form(request.headers, body)
        return await asyncio.to_thread(lambda: LocalizeRequest.read(fields).to_job())
    if media_type == "application/json":
        body = await _read_body(request, settings.max_json_bytes)
        return await asyncio.to_thread(lambda: LocalizeRequest.read_json(body).to_job())
    raise InvalidInput(
        "request.content_type",
        "this kind of body is not read here",
        field="Content-Type",
        expected="multipart/form-data or application/json",
        got=media_type or "none",
    )


async def _read_body(request: Request, limit: int) -> bytes:
    declared = request.headers.get("content-length", "")
    size = int(declared) if declared.isdecimal() and len(declared) < 20 else 0
    if size > limit:
        raise _too_large(limit, f"{size} bytes")
    body = bytearray()
    async for chunk in request.stream():
        body += chunk
        if len(body) > limit:
            raise _too_large(limit, "more")
    return bytes(body)


def _too_large(limit: int, got: str) -> TooLarge:
    return TooLarge(
        "request.too_large",
        "the request has too many bytes",
        expected=f"at most {limit} bytes",
        got=got,
    )


async def _read_form(headers: Headers, body: bytes) -> dict[str, str | bytes]:
    async def stream() -> AsyncGenerator[bytes, None]:
        for start in range(0, len(body), _CHUNK_BYTES):
            yield body[start : start + _CHUNK_BYTES]
            await asyncio.sleep(0)  # parsing 20 MB takes half a second: let others have a turn

    parser = MultiPartParser(
        headers,
        stream(),
        max_files=len(_FILES),
        max_fields=len(LocalizeRequest.model_fields),
        max_part_size=REQUEST_OVERHEAD_BYTES,
    )
    parser.spool_max_size = len(body) + 1  # files stay in memory, none on disk
    try:
        form = await parser.parse()
    except MultiPartException as error:
        raise InvalidInput(
            "request.malformed",
            error.message,
            expected="a form with a file image or features, and texts map, camera, options",
        ) from None
    fields: dict[str, str | bytes] = {}
    try:
        for name, value in form.multi_items():
            if name in fields:
                raise InvalidInput("request.duplicate_field", "given twice", field=name[:100])
            is_file = isinstance(value, UploadFile)
            if name in LocalizeRequest.model_fields and is_file != (name in _FILES):
                raise InvalidInput(
                    "request.invalid",
                    "the wrong kind of form part",
                    field=name,
                    expected="a text, without a file name"
                    if is_file
                    else f"a file, as of curl -F {name}=@{_FILES[name]}",
                )
            fields[name] = await value.read() if isinstance(value, UploadFile) else value
    finally:
        await form.close()
    return fields
