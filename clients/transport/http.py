"""Requests over HTTP."""

from __future__ import annotations

import asyncio
import json
import ssl
from collections.abc import AsyncGenerator, AsyncIterable, AsyncIterator, Mapping
from typing import Any

import httpx

from clients import errors
from clients.transport.connection import Connection
from clients.transport.http_requests import encode_request, encode_sequence, encode_upload
from clients.transport.retry import RESEND_PAUSE_S, may_resend
from clients.transport.uploads import OnProgress, Upload, pieces_async
from clients.wire.requests import CheckReady, JsonObject, Request, StartSequence
from visloc.errors import VislocError, refuse
from visloc_api.words.sequences import Instant
from visloc_api.words.wire import NDJSON

_CONNECT_TIMEOUT_S = 10.0
_LIMITS = httpx.Limits(
    max_connections=None,  # the caller decides how many requests run at once
    max_keepalive_connections=None,
    # Servers commonly close an idle connection after 5 s. Closing it earlier here keeps requests
    # off a connection that is about to be closed.
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
    503: errors.OVERLOADED,  # uvicorn's own answer when too many requests come at once
    504: errors.UNAVAILABLE,
}


class HttpTransport:
    """Sends requests to one server, from one event loop."""

    def __init__(self, connection: Connection) -> None:
        self._server, self._timeout_s = connection.server, connection.timeout_s
        self._http = httpx.AsyncClient(**_options(connection))

    async def send(self, request: Request) -> JsonObject:
        """Return the answer as plain JSON."""
        got = await self._ask(request)
        if may_resend(request, got):
            await asyncio.sleep(RESEND_PAUSE_S)
            got = await self._ask(request)
        if isinstance(got, httpx.HTTPError):
            raise self._failure(got) from got
        return _decode(self._server, request, got)

    async def stream(
        self, start: StartSequence, instants: AsyncIterable[Instant]
    ) -> AsyncGenerator[JsonObject, None]:
        """Send all instants in one request, and give each answer as it comes."""
        sent = [instant async for instant in instants]
        method, path, parts = encode_sequence(start, sent, self._timeout_s)
        try:
            async with self._http.stream(method, path, **parts) as response:
                if response.status_code != 200:
                    await response.aread()
                _check_lines(self._server, response)
                async for line in _lines(self._server, response.aiter_bytes()):
                    yield _read_line(self._server, line)
        except httpx.HTTPError as error:
            raise self._failure(error) from error

    async def upload(self, upload: Upload, on_progress: OnProgress) -> JsonObject:
        """Send a packed map, and return its description."""
        method, path, parts = encode_upload(upload, self._timeout_s)
        try:
            _refuse_published(upload, await self._http.get(path))
            response = await self._http.request(
                method, path, content=pieces_async(upload, on_progress), **parts
            )
        except httpx.HTTPError as error:
            raise self._failure(error) from error
        return _decode(self._server, None, response)

    async def close(self) -> None:
        await self._http.aclose()

    async def _ask(self, request: Request) -> httpx.Response | httpx.HTTPError:
        method, path, parts = encode_request(request, self._timeout_s)
        try:
            return await self._http.request(method, path, **parts)
        except httpx.HTTPError as error:
            return error

    def _failure(self, error: httpx.HTTPError) -> VislocError:
        if isinstance(error, httpx.TimeoutException) and not isinstance(
            error, httpx.ConnectTimeout
        ):
            return errors.timed_out(self._server, self._timeout_s)
        return errors.unreachable(self._server, _reason(error))


def _reason(error: httpx.HTTPError) -> str:
    cause: BaseException | None = error
    # The libraries in between may only say that all attempts failed.
    while isinstance(error, httpx.ConnectError) and cause is not None:
        if isinstance(cause, OSError) and cause.errno is not None:
            return str(cause)
        if isinstance(cause, BaseExceptionGroup):
            cause = cause.exceptions[-1]
            continue
        cause = cause.__cause__ or cause.__context__
    return str(error) or type(error).__name__


def _options(connection: Connection) -> dict[str, Any]:
    timeout_s, key = connection.timeout_s, connection.api_key
    verify: ssl.SSLContext | bool = connection.is_encrypted  # the usual ones take 20 ms to load
    if connection.authorities is not None:
        verify = ssl.create_default_context(cadata=connection.authorities)
    return {
        "base_url": connection.server,
        "timeout": httpx.Timeout(timeout_s, connect=min(_CONNECT_TIMEOUT_S, timeout_s)),
        "limits": _LIMITS,
        "headers": {} if key is None else {"Authorization": f"Bearer {key}"},
        "verify": verify,
    }


def _decode(server: str, request: Request | None, response: httpx.Response) -> JsonObject:
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
    """Refuse before sending: the server's own refusal is read only after the whole file is sent."""
    if described.status_code == 200:
        raise refuse(
            "map.version_exists",
            field="version",
            expected="a version that is not there",
            got=f"{upload.map_id}@{upload.version}",
        )


def _check_lines(server: str, response: httpx.Response) -> None:
    """Raise the error that a response without lines describes; its body is read already."""
    content_type = response.headers.get("content-type", "nothing")
    if response.status_code != 200:
        _decode(server, None, response)
    elif content_type.partition(";")[0].strip().lower() != NDJSON:
        raise errors.not_understood(server, f"200 with {content_type}")


async def _lines(server: str, chunks: AsyncIterable[bytes]) -> AsyncIterator[bytes]:
    """Cut chunks into lines."""
    rest = bytearray()
    async for chunk in chunks:
        # Not str.splitlines, which also cuts at characters that a line of JSON may contain.
        *lines, tail = chunk.split(b"\n")
        for line in lines:
            whole = bytes(rest + line)
            rest.clear()
            if whole.strip():
                yield whole
        rest += tail
    if rest.strip():
        raise errors.not_understood(server, f"half a line, {len(rest)} bytes")


def _read_line(server: str, line: bytes) -> JsonObject:
    """Read an answer, or raise the error that a last line describes."""
    try:
        answer = json.loads(line)
    except ValueError as error:
        raise errors.not_understood(server, f"a line that is not JSON: {error}") from None
    if not isinstance(answer, dict):
        raise errors.not_understood(server, f"a line with {type(answer).__name__}")
    problem = answer.get("problem")
    if isinstance(problem, dict):
        status = problem.get("status")
        status = status if isinstance(status, int) else 500
        raise _refusal(status, "the server failed half-way", problem)
    return answer


def _refusal(status: int, message: str, problem: Mapping[str, object]) -> VislocError:
    fallback = _FALLBACKS.get(status, errors.INTERNAL if status >= 500 else errors.INVALID)
    parts = {**problem, "message": problem.get("detail")}
    return errors.received(parts, fallback, message)
