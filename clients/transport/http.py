"""Requests over HTTP, synchronous and asynchronous."""

from __future__ import annotations

import asyncio
import json
import ssl
import time
from collections.abc import AsyncGenerator, AsyncIterable, Iterable, Iterator, Mapping
from typing import Any

import httpx

from clients import errors
from clients.transport.connection import Connection
from clients.transport.http_requests import NDJSON, encode_request, encode_sequence, encode_upload
from clients.transport.retry import RESEND_PAUSE_S, may_resend
from clients.transport.uploads import OnProgress, Upload, pieces, pieces_async
from clients.wire.requests import CheckReady, JsonObject
from clients.wire.rig_requests import AnyRequest, SentInstant, SequenceStart
from visloc.errors import VislocError, refuse

_CONNECT_TIMEOUT_S = 10.0
_LIMITS = httpx.Limits(
    max_connections=None,  # the caller decides how many requests run at once
    max_keepalive_connections=None,
    # Shorter than the 5 s after which servers commonly close an idle connection, so that no
    # request goes out on one that is just being closed.
    keepalive_expiry=2.0,
)
_FALLBACKS = {
    400: errors.INVALID,
    401: errors.UNAUTHENTICATED,
    403: errors.FORBIDDEN,
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

    def __init__(self, connection: Connection) -> None:
        self._server, self._timeout_s = connection.server, connection.timeout_s
        self._http = httpx.Client(**_options(connection))

    def send(self, request: AnyRequest) -> JsonObject:
        """Return the answer as plain JSON.

        Raises:
            VislocError: what the server refused, or ``server.*``.
        """
        got = self._ask(request)
        if may_resend(request, got):
            time.sleep(RESEND_PAUSE_S)
            got = self._ask(request)
        return _answer(self._server, self._timeout_s, request, got)

    def _ask(self, request: AnyRequest) -> httpx.Response | httpx.HTTPError:
        method, path, parts = encode_request(request, self._timeout_s)
        try:
            return self._http.request(method, path, **parts)
        except httpx.HTTPError as error:
            return error

    def stream(self, start: SequenceStart, instants: Iterable[SentInstant]) -> Iterator[JsonObject]:
        """Send all instants in one request, and give each answer as it comes.

        Raises:
            VislocError: as ``send``.
        """
        method, path, parts = encode_sequence(start, list(instants), self._timeout_s)
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

    def upload(self, upload: Upload, on_progress: OnProgress) -> JsonObject:
        """Send a packed map, and return what it is.

        Raises:
            VislocError: as ``send``, and what the file raises.
        """
        method, path, parts = encode_upload(upload, self._timeout_s)
        try:
            _refuse_published(upload, self._http.get(path))
            response = self._http.request(
                method, path, content=pieces(upload, on_progress), **parts
            )
        except httpx.HTTPError as error:
            raise _failure(self._server, self._timeout_s, error) from error
        return _decode(self._server, None, response)

    def close(self) -> None:
        """Close the connections."""
        self._http.close()


class AsyncHttpTransport:
    """``HttpTransport`` for an event loop."""

    def __init__(self, connection: Connection) -> None:
        self._server, self._timeout_s = connection.server, connection.timeout_s
        self._http = httpx.AsyncClient(**_options(connection))

    async def send(self, request: AnyRequest) -> JsonObject:
        """As ``HttpTransport.send``."""
        got = await self._ask(request)
        if may_resend(request, got):
            await asyncio.sleep(RESEND_PAUSE_S)
            got = await self._ask(request)
        return _answer(self._server, self._timeout_s, request, got)

    async def _ask(self, request: AnyRequest) -> httpx.Response | httpx.HTTPError:
        method, path, parts = encode_request(request, self._timeout_s)
        try:
            return await self._http.request(method, path, **parts)
        except httpx.HTTPError as error:
            return error

    async def stream(
        self, start: SequenceStart, instants: AsyncIterable[SentInstant]
    ) -> AsyncGenerator[JsonObject, None]:
        """As ``HttpTransport.stream``."""
        sent = [instant async for instant in instants]
        method, path, parts = encode_sequence(start, sent, self._timeout_s)
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

    async def upload(self, upload: Upload, on_progress: OnProgress) -> JsonObject:
        """As ``HttpTransport.upload``."""
        method, path, parts = encode_upload(upload, self._timeout_s)
        try:
            _refuse_published(upload, await self._http.get(path))
            response = await self._http.request(
                method, path, content=pieces_async(upload, on_progress), **parts
            )
        except httpx.HTTPError as error:
            raise _failure(self._server, self._timeout_s, error) from error
        return _decode(self._server, None, response)

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()


def _options(connection: Connection) -> dict[str, Any]:
    """Return what httpx wants to know, for its client of either kind."""
    timeout_s, key = connection.timeout_s, connection.api_key
    options: dict[str, Any] = {
        "base_url": connection.server,
        "timeout": httpx.Timeout(timeout_s, connect=min(_CONNECT_TIMEOUT_S, timeout_s)),
        "limits": _LIMITS,
        "headers": {} if key is None else {"Authorization": f"Bearer {key}"},
    }
    if connection.authorities is not None:
        options["verify"] = ssl.create_default_context(cadata=connection.authorities)
    return options


def _answer(
    server: str, timeout_s: float, request: AnyRequest, got: httpx.Response | httpx.HTTPError
) -> JsonObject:
    if isinstance(got, httpx.HTTPError):
        raise _failure(server, timeout_s, got) from got
    return _decode(server, request, got)


def _decode(server: str, request: AnyRequest | None, response: httpx.Response) -> JsonObject:
    if isinstance(request, CheckReady) and response.status_code in (200, 503):
        return {"ready": response.status_code == 200}
    if response.status_code == 204:
        return {}
    try:
        body = response.json()
    except ValueError:
        body = None
    if response.status_code in (200, 201) and isinstance(body, dict):
        return body
    if response.status_code < 400:
        content_type = response.headers.get("content-type", "nothing")
        raise errors.not_understood(server, f"{response.status_code} with {content_type}")
    message = f"the server answered {response.status_code} {response.reason_phrase}"
    raise _refusal(response.status_code, message, body if isinstance(body, dict) else {})


def _refuse_published(upload: Upload, described: httpx.Response) -> None:
    """Refuse what the server would refuse, which over HTTP is heard only when all is sent.

    Raises:
        Conflict: ``map.version_exists``.
    """
    if described.status_code == 200:
        raise refuse(
            "map.version_exists",
            field="version",
            expected="a version that is not there",
            got=f"{upload.map_id}@{upload.version}",
        )


def _check_lines(server: str, response: httpx.Response) -> None:
    """Raise what a response says that has no lines, read already."""
    content_type = response.headers.get("content-type", "nothing")
    if response.status_code != 200:
        _decode(server, None, response)
    elif content_type.partition(";")[0].strip().lower() != NDJSON:
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


def _failure(server: str, timeout_s: float, error: httpx.HTTPError) -> VislocError:
    if isinstance(error, httpx.TimeoutException) and not isinstance(error, httpx.ConnectTimeout):
        return errors.timed_out(server, timeout_s)
    return errors.unreachable(server, str(error) or type(error).__name__)
