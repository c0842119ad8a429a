"""The HTTP door."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import aclosing
from functools import partial
from http import HTTPStatus

from fastapi import Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import PlainTextResponse
from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

import visloc
from service.api import (
    Health,
    InstantAnswer,
    LocalizeResponse,
    LocalizeSequenceResponse,
    MapNotLoaded,
    Readiness,
)
from service.api.deadlines import TIMEOUT_HEADER, each_within, timeout_of, within
from service.api.message import refusal_of
from service.engine.engine import Engine
from service.errors import internal_error, request_id, stopping_error
from service.http.acceptor import OpenConnections
from service.http.access import add_access
from service.http.bodies import read_localize_job, read_rig_job, read_sequence_jobs
from service.http.maps import add_map_routes
from service.http.openapi.app import App, problems
from service.http.openapi.request_bodies import LOCALIZE_BODY, RIG_BODY, SEQUENCE_BODY
from service.http.oscp.routes import add_geopose_routes
from service.http.responses import (
    NDJSON,
    Lines,
    json_response,
    problem_response,
    while_connected,
)
from service.http.scenes import add_scene_routes
from service.http.slow_clients import Arrivals
from service.http.static_page import add_page_routes
from service.security.access import Access
from service.settings import ServiceSettings
from service.telemetry.metrics import ServiceState
from service.telemetry.metrics_port import metrics_response
from service.telemetry.observer import Observer, route_of
from service.values import Instant, InstantLocalization, SequenceStart
from visloc.errors import InvalidInput, NotFound, VislocError, refuse

logger = logging.getLogger(__name__)

# Answered even when all connections are in use.
_PROBED_PATHS = ("/healthz", "/readyz", "/metrics")

_LOCALIZE_PROBLEMS = (404, 409, 413, 422, 429, 500, 503, 504)


def create_app(
    engine: Engine,
    settings: ServiceSettings,
    *,
    observer: Observer,
    access: Access,
    arrivals: Arrivals,
    connections: OpenConnections,
    state: Callable[[], ServiceState],
) -> App:
    """Make the ASGI application. Starting and closing the engine is the caller's.

    Args:
        engine: answers.
        settings: limits.
        observer: is told what becomes of every request.
        access: who may ask for what.
        arrivals: bodies of requests while they arrive.
        connections: those that are open.
        state: how the service is doing, for /metrics.
    """

    def timeout(request: Request) -> float:
        return timeout_of(request.headers.get(TIMEOUT_HEADER), settings.request_timeout_s)

    app = App(
        title="visloc",
        version=visloc.__version__,
        summary="Localizes photos in maps of posed photos.",
        docs_url=None,  # its page loads scripts from another host
        redoc_url=None,
        redirect_slashes=False,  # to wherever the request says that this server is
    )
    app.state.observer, app.state.arrivals = observer, arrivals
    add_access(app, access, observer, page=settings.page)
    app.add_middleware(
        RequestEnvelope,
        observer=observer,
        connections=connections,
        is_stopping=lambda: engine.draining,
    )
    app.add_exception_handler(VislocError, _on_error)
    app.add_exception_handler(RequestValidationError, _on_validation_error)
    app.add_exception_handler(HTTPException, _on_http_exception)

    @app.post(
        "/localize",
        response_model=LocalizeResponse,
        responses=problems(*_LOCALIZE_PROBLEMS),
        openapi_extra={"requestBody": LOCALIZE_BODY},
    )
    async def localize(request: Request) -> Response:
        """Estimate the camera pose of one photo, or of its features, in one map.

        A photo that cannot be localized is an answer (`status: not_localized`), not an error.
        """
        timeout_s = timeout(request)
        engine.check_room()
        job = await read_localize_job(request, settings)
        async with within(timeout_s):
            found = await while_connected(request.receive, engine.localize(job))
        observer.localization(found)
        return json_response(LocalizeResponse.from_localization(found, request.state.request_id))

    @app.post(
        "/localize/rig",
        response_model=InstantAnswer,
        responses=problems(*_LOCALIZE_PROBLEMS),
        openapi_extra={"requestBody": RIG_BODY},
    )
    async def localize_rig(request: Request) -> Response:
        """Estimate one pose from the photos that the cameras of a rig took at one instant.

        A photo that cannot be used fails alone: the others are answered.
        """
        timeout_s = timeout(request)
        job = await read_rig_job(request, settings)
        with engine.admit_batch():
            async with within(timeout_s):
                found = await while_connected(request.receive, engine.localize_rig(job))
        observer.instant(found)
        return json_response(InstantAnswer.from_localization(found, request.state.request_id))

    @app.post(
        "/localize/sequence",
        response_model=LocalizeSequenceResponse,
        responses=problems(*_LOCALIZE_PROBLEMS),
        openapi_extra={"requestBody": SEQUENCE_BODY},
    )
    async def localize_sequence(request: Request) -> Response:
        """Estimate the poses of a rig, or of one camera, at the instants of a sequence.

        With `Accept: application/x-ndjson` every answer is a line of its own, sent as soon as it
        is final.
        """
        timeout_s = timeout(request)
        start, instants = await read_sequence_jobs(request, settings)
        answers = _observed(_admitted(engine, start, instants), timeout_s, observer)
        id_ = request.state.request_id
        message = partial(InstantAnswer.from_localization, request_id=id_)
        if _wants_lines(request):
            first = await while_connected(request.receive, _next_of(answers))
            return Lines(first, answers, message, id_, settings.arrival_timeout_s)
        texts = await while_connected(request.receive, _texts_of(answers, message))
        return _sequence_response(texts, id_)

    @app.get("/healthz", response_model=Health)
    async def healthz() -> Response:
        """Tell that the process answers."""
        return json_response(Health(version=visloc.__version__))

    @app.get("/readyz", response_model=Readiness, responses={503: {"model": Readiness}})
    async def readyz() -> Response:
        """Tell whether maps and networks are warm: 200, or 503 while they are not."""
        status = engine.status
        not_loaded = [
            MapNotLoaded(id=map_id, code=error.code, message=str(error))
            for map_id, error in status.not_loaded.items()
        ]
        readiness = Readiness(ready=status.ready, maps=list(status.maps), not_loaded=not_loaded)
        return json_response(readiness, 200 if status.ready else 503)

    async def render() -> tuple[bytes, str]:
        return await asyncio.to_thread(observer.metrics.render, state())

    @app.get(
        "/metrics",
        response_class=PlainTextResponse,
        responses={200: {"content": {"text/plain": {}}, "description": "Prometheus metrics"}},
    )
    async def metrics() -> Response:
        """Say how the service is doing, for Prometheus."""
        return await metrics_response(render)

    add_map_routes(app, engine, settings)
    add_scene_routes(app, engine, settings)
    add_geopose_routes(app, engine, settings)
    if settings.page:
        add_page_routes(app)
    return app


class RequestEnvelope:
    """Gives every request an id, a line in the log, and an answer even when something broke."""

    def __init__(
        self,
        app: ASGIApp,
        observer: Observer,
        connections: OpenConnections,
        is_stopping: Callable[[], bool],
    ) -> None:
        self._app = app
        self._observer = observer
        self._connections = connections
        self._is_stopping = is_stopping

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        id_ = request_id(headers.get("x-request-id"))
        scope.setdefault("state", {})["request_id"] = id_
        with self._observer.request("http", id_, traceparent=headers.get("traceparent")) as record:
            record.peer = scope["client"][0] if scope.get("client") else None

            async def send_with_id(message: Message) -> None:
                if message["type"] == "http.response.start":
                    record.status = str(message["status"])
                    ours = MutableHeaders(scope=message)
                    ours["X-Request-Id"] = id_
                    if self._is_stopping():  # else the next request would be cut off
                        ours["Connection"] = "close"
                    if record.trace is not None:
                        ours["traceresponse"] = record.trace.traceparent
                await send(message)

            try:
                if "content-length" in headers and "transfer-encoding" in headers:
                    # RFC 9112, 6.3: a proxy may have understood it otherwise.
                    refused = _ambiguous()
                    await self._refuse(
                        refused, id_, scope, receive, send_with_id, HTTPStatus.BAD_REQUEST
                    )
                    return
                if self._connections.is_busy and scope["path"] not in _PROBED_PATHS:
                    await self._refuse(_busy(), id_, scope, receive, send_with_id)
                    return
                await self._app(scope, receive, send_with_id)
            except asyncio.CancelledError:
                if record.status or not self._is_stopping():
                    raise
                await self._refuse(stopping_error(), id_, scope, receive, send_with_id)
            except ClientDisconnect:
                logger.info("the client of request %s left before it was answered", id_)
            except Exception:  # the last line of defence: whatever it is, the caller gets an answer
                logger.exception("request %s broke", id_)
                if record.status:
                    raise  # too late to answer: the server closes the connection
                await self._refuse(internal_error(), id_, scope, receive, send_with_id)
            finally:
                record.route = route_of(scope)

    async def _refuse(
        self,
        error: VislocError,
        id_: str,
        scope: Scope,
        receive: Receive,
        send: Send,
        status: HTTPStatus | None = None,
    ) -> None:
        self._observer.error(error)
        response = problem_response(error, id_, status)
        response.headers["Connection"] = "close"
        await response(scope, receive, send)


def _busy() -> VislocError:
    return refuse("server.busy", "all connections are busy; try again shortly")


def _ambiguous() -> VislocError:
    return refuse("request.framing", field="Transfer-Encoding")


async def _next_of(answers: AsyncGenerator[InstantLocalization]) -> InstantLocalization:
    return await anext(answers)


async def _texts_of(
    answers: AsyncGenerator[InstantLocalization],
    message: Callable[[InstantLocalization], InstantAnswer],
) -> list[bytes]:
    # As text, each takes a seventh of the memory.
    async with aclosing(answers):
        return [message(answer).model_dump_json().encode() async for answer in answers]


def _sequence_response(texts: Sequence[bytes], id_: str) -> Response:
    body = b'{"request_id":%b,"answers":[%b]}' % (json.dumps(id_).encode(), b",".join(texts))
    return Response(body, media_type="application/json")


def _wants_lines(request: Request) -> bool:
    accepted = ",".join(request.headers.getlist("accept")).lower().split(",")
    return any(kind.partition(";")[0].strip() == NDJSON for kind in accepted)


async def _admitted(
    engine: Engine, start: SequenceStart, instants: Sequence[Instant]
) -> AsyncGenerator[InstantLocalization]:
    with engine.admit_batch():
        async with aclosing(engine.localize_sequence(start, instants)) as answers:
            async for answer in answers:
                yield answer


async def _observed(
    answers: AsyncGenerator[InstantLocalization], timeout_s: float, observer: Observer
) -> AsyncGenerator[InstantLocalization]:
    """Give answers on, each within its time, and take note of them."""
    async with aclosing(answers), aclosing(each_within(timeout_s, answers)) as timed:
        async for answer in timed:
            observer.instant(answer)
            yield answer


def _refused(request: Request, error: VislocError, status: HTTPStatus | None = None) -> Response:
    request.app.state.observer.error(error)
    return problem_response(error, request.state.request_id, status)


async def _on_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, VislocError)  # it is registered for these
    return _refused(request, error)


async def _on_validation_error(request: Request, error: Exception) -> Response:
    """Say what FastAPI finds wrong in a path or a query in our words."""
    assert isinstance(error, RequestValidationError)
    return _refused(request, refusal_of(error.errors()[0]))


async def _on_http_exception(request: Request, error: Exception) -> Response:
    """Say Starlette's own refusals, an unknown path or method, in our words."""
    assert isinstance(error, HTTPException)
    status = HTTPStatus(error.status_code)
    kind = NotFound if status == HTTPStatus.NOT_FOUND else InvalidInput
    name = status.phrase.lower().replace(" ", "_").replace("-", "_")
    asked = f"{request.method} {request.url.path}"
    refused = refuse(f"http.{name}", status.phrase, got=asked, kind=kind)
    response = _refused(request, refused, status)
    response.headers.update(error.headers or {})
    return response
