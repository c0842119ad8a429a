"""Requests over HTTP, synchronous and asynchronous."""

from __future__ import annotations

import json
from collections.abc import AsyncGenerator, AsyncIterable, Iterable, Iterator, Mapping, Sequence
from typing import Any, assert_never

import httpx

from clients import errors
from clients.features import Features
from clients.priors import priors_as_json
from clients.requests import CheckReady, GetMap, GetServer, JsonObject, ListMaps, Localize, Search
from clients.rig_requests import (
    AnyRequest,
    LocalizeRig,
    SentImage,
    SentInstant,
    SequenceStart,
    camera_as_json,
    odometry_as_json,
    rig_as_json,
    search_as_json,
)
from visloc.errors import Unavailable, VislocError

_CONNECT_TIMEOUT_S = 10.0
_NDJSON = "application/x-ndjson"
_LIMITS = httpx.Limits(
    max_connections=None,  # the caller decides how many requests run at once
    max_keepalive_connections=None,
    # Shorter than the 5 s after which servers commonly close an idle connection, so that no
    # request goes out on one that is just being closed.
    keepalive_expiry=2.0,
)
_FALLBACKS = {
    400: errors.INVALID,
    404: errors.NOT_FOUND,
    409: errors.CONFLICT,
    413: errors.TOO_LARGE,
    422: errors.INVALID,
    429: errors.OVERLOADED,
    502: errors.UNAVAILABLE,
    503: errors.OVERLOADED,  # without our words: uvicorn's, when too many requests come at once
    504: errors.UNAVAILABLE,
}


class HttpTransport:
    """Sends requests and waits for the answers; safe to share between threads."""

    def __init__(self, server: str, timeout_s: float) -> None:
        self._server, self._timeout_s = server, timeout_s
        self._http = httpx.Client(base_url=server, timeout=_timeout(timeout_s), limits=_LIMITS)

    def send(self, request: AnyRequest) -> JsonObject:
        """Return the answer as plain JSON.

        Raises:
            VislocError: what the server refused, or ``server.*``.
        """
        method, path, parts = _encode(request)
        try:
            response = self._http.request(method, path, **parts)
        except httpx.HTTPError as error:
            raise _failure(self._server, self._timeout_s, error) from error
        return _decode(self._server, request, response)

    def stream(self, start: SequenceStart, instants: Iterable[SentInstant]) -> Iterator[JsonObject]:
        """Send all instants in one request, and give each answer as it comes.

        Raises:
            VislocError: as ``send``.
        """
        method, path, parts = _encode_sequence(start, list(instants))
        try:
            with self._http.stream(method, path, **parts) as response:
                if response.status_code != 200:
                    response.read()
                _check_lines(self._server, response)
                lines = _Lines(self._server)
                for chunk in response.iter_bytes():
                    yield from lines.take(chunk)
                lines.finish()
        except httpx.HTTPError as error:
            raise _failure(self._server, self._timeout_s, error) from error

    def close(self) -> None:
        """Close the connections."""
        self._http.close()


class AsyncHttpTransport:
    """``HttpTransport`` for an event loop."""

    def __init__(self, server: str, timeout_s: float) -> None:
        self._server, self._timeout_s = server, timeout_s
        self._http = httpx.AsyncClient(base_url=server, timeout=_timeout(timeout_s), limits=_LIMITS)

    async def send(self, request: AnyRequest) -> JsonObject:
        """As ``HttpTransport.send``."""
        method, path, parts = _encode(request)
        try:
            response = await self._http.request(method, path, **parts)
        except httpx.HTTPError as error:
            raise _failure(self._server, self._timeout_s, error) from error
        return _decode(self._server, request, response)

    async def stream(
        self, start: SequenceStart, instants: AsyncIterable[SentInstant]
    ) -> AsyncGenerator[JsonObject, None]:
        """As ``HttpTransport.stream``."""
        method, path, parts = _encode_sequence(start, [instant async for instant in instants])
        try:
            async with self._http.stream(method, path, **parts) as response:
                if response.status_code != 200:
                    await response.aread()
                _check_lines(self._server, response)
                lines = _Lines(self._server)
                async for chunk in response.aiter_bytes():
                    for answer in lines.take(chunk):
                        yield answer
                lines.finish()
        except httpx.HTTPError as error:
            raise _failure(self._server, self._timeout_s, error) from error

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()


def _timeout(timeout_s: float) -> httpx.Timeout:
    return httpx.Timeout(timeout_s, connect=min(_CONNECT_TIMEOUT_S, timeout_s))


def _encode(request: AnyRequest) -> tuple[str, str, dict[str, Any]]:
    """Return method, path and the rest of what httpx wants."""
    match request:
        case Localize():
            headers = _id_header(request.search)
            fields = _fields(request)
            parts = {"data": fields, "files": _file(request.query), "headers": headers}
            return "POST", "/localize", parts
        case LocalizeRig():
            files = _Files()
            asked = search_as_json(request.search) | {
                "rig": rig_as_json(request.rig),
                "images": files.images(request.images),
            }
            return "POST", "/localize/rig", files.form(asked, _id_header(request.search))
        case ListMaps():
            return "GET", "/maps", {}
        case GetMap():
            return "GET", f"/maps/{request.map}", {}
        case GetServer():
            return "GET", "/healthz", {}
        case CheckReady():
            return "GET", "/readyz", {}
    assert_never(request)


def _encode_sequence(
    start: SequenceStart, instants: Sequence[SentInstant]
) -> tuple[str, str, dict[str, Any]]:
    files = _Files()
    asked = search_as_json(start.search) | {"instants": [files.instant(i) for i in instants]}
    if start.rig is not None:
        asked["rig"] = rig_as_json(start.rig)
    if start.time_unit is not None:
        asked["time_unit"] = start.time_unit
    if start.max_gap_s is not None:
        asked["max_gap_s"] = start.max_gap_s
    headers = _id_header(start.search) | {"Accept": _NDJSON}
    return "POST", "/localize/sequence", files.form(asked, headers)


class _Files:
    """The photos of a form, whose other part says what each is."""

    def __init__(self) -> None:
        self._parts: dict[str, tuple[str, bytes, str]] = {}

    def images(self, images: Iterable[SentImage]) -> list[JsonObject]:
        """Add photos, and return what the form says of them."""
        return [self._image(image) for image in images]

    def instant(self, instant: SentInstant) -> JsonObject:
        """Add the photos of an instant, and return what the form says of it."""
        said: JsonObject = {
            "timestamp": instant.timestamp,
            "images": self.images(instant.images),
        }
        if instant.odometry is not None:
            said["odometry"] = odometry_as_json(instant.odometry)
        if instant.priors is not None:
            said["priors"] = priors_as_json(instant.priors)
        return said

    def form(self, asked: JsonObject, headers: Mapping[str, str]) -> dict[str, Any]:
        """Return what httpx wants."""
        # As a part of its own kind also where there is no file, so that it is a form in any case.
        text = json.dumps(asked).encode()
        files = {"request": (None, text, "application/json"), **self._parts}
        return {"files": files, "headers": headers}

    def _image(self, image: SentImage) -> JsonObject:
        said: JsonObject = {"sensor": image.sensor}
        if isinstance(image.query, Features):
            said["features"] = image.query.as_json()
        else:
            name = f"image{len(self._parts)}"
            self._parts[name] = ("photo", image.query, "application/octet-stream")
            said["part"] = name
        if image.camera is not None:
            said["camera"] = camera_as_json(image.camera)
        if image.timestamp is not None:
            said["timestamp"] = image.timestamp
        return said


def _fields(request: Localize) -> dict[str, str]:
    """Return the texts of a form for one photo."""
    said = search_as_json(request.search)
    fields = {name: json.dumps(value) for name, value in said.items() if name != "map"}
    if "map" in said:
        fields["map"] = said["map"]
    if request.camera is not None:
        fields["camera"] = json.dumps(camera_as_json(request.camera))
    return fields


def _id_header(search: Search) -> dict[str, str]:
    return {} if search.request_id is None else {"X-Request-ID": search.request_id}


def _file(query: bytes | Features) -> dict[str, tuple[str, bytes, str]]:
    if isinstance(query, Features):
        text = json.dumps(query.as_json()).encode()
        return {"features": ("features.json", text, "application/json")}
    return {"image": ("photo", query, "application/octet-stream")}


def _decode(server: str, request: AnyRequest | None, response: httpx.Response) -> JsonObject:
    if isinstance(request, CheckReady) and response.status_code in (200, 503):
        return {"ready": response.status_code == 200}
    try:
        body = response.json()
    except ValueError:
        body = None
    if response.status_code == 200 and isinstance(body, dict):
        return body
    if response.status_code < 400:
        content_type = response.headers.get("content-type", "nothing")
        raise errors.not_understood(server, f"{response.status_code} with {content_type}")
    message = f"the server answered {response.status_code} {response.reason_phrase}"
    raise _refusal(response.status_code, message, body if isinstance(body, dict) else {})


def _check_lines(server: str, response: httpx.Response) -> None:
    """Raise what a response says that has no lines, read already."""
    content_type = response.headers.get("content-type", "nothing")
    if response.status_code != 200:
        _decode(server, None, response)
    elif content_type.partition(";")[0].strip().lower() != _NDJSON:
        raise errors.not_understood(server, f"200 with {content_type}")


class _Lines:
    """Cuts chunks into lines of JSON."""

    def __init__(self, server: str) -> None:
        self._server = server
        self._rest = bytearray()

    def take(self, chunk: bytes) -> Iterator[JsonObject]:
        """Give the objects that are whole now.

        Raises:
            VislocError: what a last line says went wrong, or ``server.answer``.
        """
        # Not by str.splitlines: a line of JSON may hold what it takes for an end of line.
        *lines, rest = chunk.split(b"\n")
        for line in lines:
            whole = bytes(self._rest + line)
            self._rest.clear()
            if whole.strip():
                yield self._read(whole)
        self._rest += rest

    def finish(self) -> None:
        """Take note of the end.

        Raises:
            VislocError: ``server.answer`` when it came within a line.
        """
        if self._rest.strip():
            raise errors.not_understood(self._server, f"half a line, {len(self._rest)} bytes")

    def _read(self, line: bytes) -> JsonObject:
        try:
            said = json.loads(line)
        except ValueError as error:
            raise errors.not_understood(self._server, f"a line that is not JSON: {error}") from None
        if not isinstance(said, dict):
            raise errors.not_understood(self._server, f"a line with {type(said).__name__}")
        problem = said.get("problem")
        if isinstance(problem, dict):
            status = problem.get("status")
            status = status if isinstance(status, int) else 500
            raise _refusal(status, "the server failed half-way", problem)
        return said


def _refusal(status: int, message: str, problem: Mapping[str, object]) -> VislocError:
    fallback = _FALLBACKS.get(status, errors.INTERNAL if status >= 500 else errors.INVALID)
    parts = {**problem, "message": problem.get("detail")}
    return errors.received(parts, fallback, message)


def _failure(server: str, timeout_s: float, error: httpx.HTTPError) -> Unavailable:
    if isinstance(error, httpx.TimeoutException) and not isinstance(error, httpx.ConnectTimeout):
        return errors.timed_out(server, timeout_s)
    return errors.unreachable(server, str(error) or type(error).__name__)
