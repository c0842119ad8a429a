"""The outermost layer of the HTTP API: ids, the log, answers to all requests; what routes use."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from dataclasses import dataclass
from http import HTTPStatus

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import ClientDisconnect, Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.api.deadlines import TimeLimit, request_id, time_limit_of
from service.engine.engine import Engine
from service.errors import internal_error, stopping_error
from service.http.arrivals import Arrivals
from service.http.responses import problem_response
from service.security.access import FORWARDED_HEADER, Access
from service.settings import ServiceSettings
from service.telemetry.logs import UNMATCHED, RequestRecord
from service.telemetry.metrics import ServiceState
from service.telemetry.observer import Observer
from service.telemetry.tracing import traceparent_of
from visloc.errors import VislocError, refuse
from visloc_api.words.wire import TIMEOUT_HEADER

logger = logging.getLogger(__name__)

# Routes that are answered even when there are too many requests.
PROBED_PATHS = ("/healthz", "/readyz", "/metrics")
_METHODS = ("GET", "HEAD", "POST", "PUT", "DELETE", "OPTIONS", "PATCH")


class RequestEnvelope:
    """Gives every request an id, a log line, and an answer even when the code behind it fails."""

    def __init__(self, app: ASGIApp, backend: Backend) -> None:
        self._app = app
        self._engine = backend.engine
        self._observer = backend.observer
        self._access = backend.access
        limit = backend.settings.max_connections
        self._running, self._most_running = 0, limit - min(max(1, limit // 10), limit - 1)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        id_ = request_id(headers.get("x-request-id"))
        scope.setdefault("state", {})["request_id"] = id_
        with self._observer.request("http", id_, traceparent=headers.get("traceparent")) as record:
            peer = scope["client"][0] if scope.get("client") else None
            record.peer = self._access.caller(peer, headers.getlist(FORWARDED_HEADER))

            async def send_with_id(message: Message) -> None:
                if message["type"] == "http.response.start":
                    self._complete(message, record)
                await send(message)

            self._running += 1
            try:
                await self._serve(record, scope, receive, send_with_id)
            finally:
                self._running -= 1
                record.route = route_of(scope)

    def _complete(self, start: Message, record: RequestRecord) -> None:
        """Record the status of an answer that starts, and add our headers to it."""
        record.status = str(start["status"])
        headers = MutableHeaders(scope=start)
        headers["X-Request-Id"] = record.request_id
        if self._engine.draining:  # otherwise the next request would be cut off
            headers["Connection"] = "close"
        if record.trace is not None:
            headers["traceresponse"] = traceparent_of(record.trace)

    async def _serve(
        self, record: RequestRecord, scope: Scope, receive: Receive, send: Send
    ) -> None:
        async def refuse(error: VislocError, status: HTTPStatus | None = None) -> None:
            self._observer.error(error)
            response = problem_response(error, record.request_id, status)
            response.headers["Connection"] = "close"
            await response(scope, receive, send)

        headers = Headers(scope=scope)
        try:
            if "content-length" in headers and "transfer-encoding" in headers:
                # RFC 9112, 6.3: a proxy may have read the request differently.
                await refuse(_ambiguous(), HTTPStatus.BAD_REQUEST)
            elif self._running > self._most_running and scope["path"] not in PROBED_PATHS:
                await refuse(_busy())
            else:
                await self._app(scope, receive, send)
        except asyncio.CancelledError:
            if record.status or not self._engine.draining:
                raise
            await refuse(stopping_error())
        except ClientDisconnect:
            if record.status:  # otherwise the log has it as cancelled
                logger.info("the client of request %s left within the answer", record.request_id)
        except Exception:  # the last line of defence: every caller gets an answer
            logger.exception("request %s failed unexpectedly", record.request_id)
            if record.status:
                raise  # too late to answer: the server closes the connection
            await refuse(internal_error())


def route_of(scope: Scope) -> str:
    """Return the method and the path template of a served request, as ``GET /maps/{ref}``."""
    path = getattr(scope.get("route"), "path", None)
    method = scope["method"]
    if path is None or method not in _METHODS:
        return UNMATCHED
    return f"{method} {path}"


def _busy() -> VislocError:
    return refuse("server.busy", "all connections are busy; try again shortly")


def _ambiguous() -> VislocError:
    return refuse("request.framing", field="Transfer-Encoding")


@dataclass(frozen=True, slots=True)
class Backend:
    """The parts of the service behind the HTTP API.

    Attributes:
        arrivals: the request bodies that are arriving.
        state: returns the current state of the service, for ``/metrics``.
    """

    engine: Engine
    settings: ServiceSettings
    observer: Observer
    access: Access
    arrivals: Arrivals
    state: Callable[[], ServiceState]


def backend_of(request: Request) -> Backend:
    """Return the backend that ``create_app`` put into the state of the app."""
    backend: Backend = request.app.state.backend
    return backend


def limit_of(request: Request) -> TimeLimit:
    """Return the time that the request may take."""
    limit_s = backend_of(request).settings.request_timeout_s
    return time_limit_of(request.headers.get(TIMEOUT_HEADER), limit_s)
