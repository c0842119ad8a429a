"""The HTTP door."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Coroutine
from http import HTTPStatus
from time import perf_counter
from typing import Any, TypeVar

from fastapi import Request, Response
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel
from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

import visloc
from service.engine import Engine
from service.incoming import invalid_input
from service.intake import read_localize_job
from service.openapi import LOCALIZE_BODY, App, problems
from service.schemas import (
    Health,
    ListMapsResponse,
    LocalizeResponse,
    MapInfo,
    MapNotLoaded,
    Problem,
    Readiness,
)
from service.settings import ServiceSettings
from service.wire import RETRY_AFTER_S, internal_error, request_id, statuses_of
from visloc.errors import InvalidInput, NotFound, Unavailable, VislocError

logger = logging.getLogger(__name__)

T = TypeVar("T")


def create_app(engine: Engine, settings: ServiceSettings) -> App:
    """Make the ASGI application. Starting and closing the engine is the caller's."""
    app = App(
        title="visloc",
        version=visloc.__version__,
        summary="Localizes photos in maps of posed photos.",
        docs_url=None,  # its page loads scripts from another host
        redoc_url=None,
    )
    app.add_middleware(RequestEnvelope)
    app.add_exception_handler(VislocError, _on_error)
    app.add_exception_handler(RequestValidationError, _on_validation_error)
    app.add_exception_handler(HTTPException, _on_http_exception)

    @app.post(
        "/localize",
        response_model=LocalizeResponse,
        responses=problems(404, 409, 413, 422, 429, 500, 503),
        openapi_extra={"requestBody": LOCALIZE_BODY},
    )
    async def localize(request: Request) -> Response:
        """Estimate the camera pose of one photo, or of its features, in one map.

        A photo that cannot be localized is an answer (`status: not_localized`), not an error.
        """
        job = await read_localize_job(request, settings)
        found = await _while_connected(request, engine.localize(job))
        return _json(LocalizeResponse.from_localization(found, request.state.request_id))

    @app.get("/maps", response_model=ListMapsResponse)
    async def list_maps() -> Response:
        """List the maps that can be opened, in the version that is served."""
        maps = [MapInfo.from_map(opened) for opened in await engine.maps()]
        return _json(ListMapsResponse(maps=maps))

    @app.get("/maps/{ref}", response_model=MapInfo, responses=problems(404, 422, 500))
    async def get_map(ref: str) -> Response:
        """Describe one map: `id`, or `id@version`."""
        return _json(MapInfo.from_map(await engine.map(ref)))

    @app.get("/healthz", response_model=Health)
    async def healthz() -> Response:
        """Tell that the process answers."""
        return _json(Health(version=visloc.__version__))

    @app.get("/readyz", response_model=Readiness, responses={503: {"model": Readiness}})
    async def readyz() -> Response:
        """Tell whether maps and networks are warm: 200, or 503 while they are not."""
        status = engine.status
        not_loaded = [
            MapNotLoaded(id=map_id, code=error.code, message=str(error))
            for map_id, error in status.not_loaded.items()
        ]
        readiness = Readiness(ready=status.ready, maps=list(status.maps), not_loaded=not_loaded)
        return _json(readiness, 200 if status.ready else 503)

    return app


class RequestEnvelope:
    """Gives every request an id, a line in the log, and an answer even when something broke."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        started = perf_counter()
        id_ = request_id(Headers(scope=scope).get("x-request-id"))
        scope.setdefault("state", {})["request_id"] = id_
        status = 0

        async def send_with_id(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                MutableHeaders(scope=message)["X-Request-Id"] = id_
            await send(message)

        try:
            await self._app(scope, receive, send_with_id)
        except ClientDisconnect:
            logger.info("the client of request %s left before it was answered", id_)
        except Exception:  # the last line of defence: whatever it is, the caller gets an answer
            logger.exception("request %s broke", id_)
            if status:
                raise  # too late to answer: the server closes the connection
            await _problem(internal_error(), id_)(scope, receive, send_with_id)
        finally:
            logger.info(
                "%s %r %d %.1f ms request_id=%s",
                *(scope["method"], scope["path"], status),
                *((perf_counter() - started) * 1000, id_),
            )


async def _while_connected(request: Request, work: Coroutine[Any, Any, T]) -> T:
    """Do the work, or drop it when the client hangs up: nobody waits for its answer.

    Raises:
        ClientDisconnect: when the client hung up.
    """

    async def hang_up() -> None:
        while (await request.receive())["type"] != "http.disconnect":
            pass

    working, leaving = asyncio.create_task(work), asyncio.create_task(hang_up())
    try:
        await asyncio.wait({working, leaving}, return_when=asyncio.FIRST_COMPLETED)
        if not working.done():
            raise ClientDisconnect
        return working.result()
    finally:
        working.cancel()
        leaving.cancel()


def _json(message: BaseModel, status: int = 200) -> Response:
    return Response(message.model_dump_json(), status, media_type="application/json")


def _problem(error: VislocError, id_: str, status: HTTPStatus | None = None) -> Response:
    status = status or statuses_of(error)[0]
    problem = Problem(
        title=status.phrase,
        status=status,
        detail=error.message,
        code=error.code,
        field=error.field,
        expected=error.expected,
        got=error.got,
        kind=type(error).__name__,
        request_id=id_,
    )
    return Response(
        problem.model_dump_json(),
        status,
        {"Retry-After": str(RETRY_AFTER_S)} if isinstance(error, Unavailable) else None,
        media_type="application/problem+json",
    )


async def _on_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, VislocError)  # it is registered for these
    return _problem(error, request.state.request_id)


async def _on_validation_error(request: Request, error: Exception) -> Response:
    """Say what FastAPI finds wrong in a path or a query in our words."""
    assert isinstance(error, RequestValidationError)
    return _problem(invalid_input(error.errors()[0]), request.state.request_id)


async def _on_http_exception(request: Request, error: Exception) -> Response:
    """Say Starlette's own refusals, an unknown path or method, in our words."""
    assert isinstance(error, HTTPException)
    status = HTTPStatus(error.status_code)
    kind = NotFound if status == HTTPStatus.NOT_FOUND else InvalidInput
    code = "http." + status.phrase.lower().replace(" ", "_").replace("-", "_")
    refused = kind(code, status.phrase, got=f"{request.method} {request.url.path}")
    response = _problem(refused, request.state.request_id, status)
    response.headers.update(error.headers or {})
    return response
