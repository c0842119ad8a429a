"""Requests over HTTP, synchronous and asynchronous."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, assert_never

import httpx

from clients import errors
from clients.features import Features
from clients.requests import (
    CheckReady,
    GetMap,
    GetServer,
    JsonObject,
    ListMaps,
    Localize,
    Request,
)
from visloc.errors import Unavailable, VislocError

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

    def send(self, request: Request) -> JsonObject:
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

    def close(self) -> None:
        """Close the connections."""
        self._http.close()


class AsyncHttpTransport:
    """``HttpTransport`` for an event loop."""

    def __init__(self, server: str, timeout_s: float) -> None:
        self._server, self._timeout_s = server, timeout_s
        self._http = httpx.AsyncClient(base_url=server, timeout=_timeout(timeout_s), limits=_LIMITS)

    async def send(self, request: Request) -> JsonObject:
        """As ``HttpTransport.send``."""
        method, path, parts = _encode(request)
        try:
            response = await self._http.request(method, path, **parts)
        except httpx.HTTPError as error:
            raise _failure(self._server, self._timeout_s, error) from error
        return _decode(self._server, request, response)

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()


def _timeout(timeout_s: float) -> httpx.Timeout:
    return httpx.Timeout(timeout_s, connect=min(_CONNECT_TIMEOUT_S, timeout_s))


def _encode(request: Request) -> tuple[str, str, dict[str, Any]]:
    """Return method, path and the rest of what httpx wants."""
    match request:
        case Localize():
            fields = {"map": request.map, "options": json.dumps(request.options.given())}
            if request.camera is not None:
                fields["camera"] = json.dumps(asdict(request.camera))
            headers = {} if request.request_id is None else {"X-Request-ID": request.request_id}
            parts = {"data": fields, "files": _file(request.query), "headers": headers}
            return "POST", "/localize", parts
        case ListMaps():
            return "GET", "/maps", {}
        case GetMap():
            return "GET", f"/maps/{request.map}", {}
        case GetServer():
            return "GET", "/healthz", {}
        case CheckReady():
            return "GET", "/readyz", {}
    assert_never(request)


def _file(query: bytes | Features) -> dict[str, tuple[str, bytes, str]]:
    if isinstance(query, Features):
        text = json.dumps(query.as_json()).encode()
        return {"features": ("features.json", text, "application/json")}
    return {"image": ("photo", query, "application/octet-stream")}


def _decode(server: str, request: Request, response: httpx.Response) -> JsonObject:
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
    raise _refusal(response, body if isinstance(body, dict) else {})


def _refusal(response: httpx.Response, problem: Mapping[str, object]) -> VislocError:
    fallback = _FALLBACKS.get(
        response.status_code, errors.INTERNAL if response.status_code >= 500 else errors.INVALID
    )
    message = f"the server answered {response.status_code} {response.reason_phrase}"
    parts = {**problem, "message": problem.get("detail")}
    return errors.received(parts, fallback, message)


def _failure(server: str, timeout_s: float, error: httpx.HTTPError) -> Unavailable:
    if isinstance(error, httpx.TimeoutException) and not isinstance(error, httpx.ConnectTimeout):
        return errors.timed_out(server, timeout_s)
    return errors.unreachable(server, str(error) or type(error).__name__)
