"""The HTTP door."""

from __future__ import annotations

import json
import logging
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Sequence
from contextlib import aclosing
from functools import partial
from http import HTTPStatus
from time import perf_counter

from fastapi import Depends, Request, Response
from fastapi.exceptions import RequestValidationError
from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

import visloc
from service.engine import Engine
from service.incoming import refusal_of
from service.intake import read_localize_job, read_rig_job, read_sequence_jobs
from service.jobs import InstantLocalization
from service.openapi import App, problems
from service.request_bodies import LOCALIZE_BODY, RIG_BODY, SEQUENCE_BODY
from service.responses import (
    NDJSON,
    Lines,
    json_response,
    problem_response,
    while_connected,
)
from service.schemas import (
    Health,
    InstantAnswer,
    ListMapsResponse,
    LocalizeResponse,
    LocalizeSequenceResponse,
    MapInfo,
    MapNotLoaded,
    Readiness,
)
from service.settings import ServiceSettings
from service.wire import internal_error, request_id
from visloc.errors import InvalidInput, NotFound, VislocError

logger = logging.getLogger(__name__)


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
        found = await while_connected(request.receive, engine.localize(job))
        return json_response(LocalizeResponse.from_localization(found, request.state.request_id))

    async def admitted() -> AsyncIterator[None]:
        # FastAPI ends this when the answer has been sent, its last line included: since 0.118.
        with engine.admit_batch():
            yield

    @app.post(
        "/localize/rig",
        response_model=InstantAnswer,
        responses=problems(404, 409, 413, 422, 429, 500, 503),
        openapi_extra={"requestBody": RIG_BODY},
        dependencies=[Depends(admitted)],
    )
    async def localize_rig(request: Request) -> Response:
        """Estimate one pose from the photos that the cameras of a rig took at one instant.

        A photo that cannot be used fails alone: the others are answered.
        """
        job = await read_rig_job(request, settings)
        found = await while_connected(request.receive, engine.localize_rig(job))
        return json_response(InstantAnswer.from_localization(found, request.state.request_id))

    @app.post(
        "/localize/sequence",
        response_model=LocalizeSequenceResponse,
        responses=problems(404, 409, 413, 422, 429, 500, 503),
        openapi_extra={"requestBody": SEQUENCE_BODY},
        dependencies=[Depends(admitted)],
    )
    async def localize_sequence(request: Request) -> Response:
        """Estimate the poses of a rig, or of one camera, at the instants of a sequence.

        With `Accept: application/x-ndjson` every answer is a line of its own, sent as soon as it
        is final.
        """
        start, instants = await read_sequence_jobs(request, settings)
        answers = engine.localize_sequence(start, instants)
        id_ = request.state.request_id
        message = partial(InstantAnswer.from_localization, request_id=id_)
        if _wants_lines(request):
            first = await while_connected(request.receive, _next_of(answers))
            return Lines(first, answers, message, id_)
        texts = await while_connected(request.receive, _texts_of(answers, message))
        return _sequence_response(texts, id_)

    @app.get("/maps", response_model=ListMapsResponse)
    async def list_maps() -> Response:
        """List the maps that can be opened, in the version that is served."""
        maps = [MapInfo.from_map(opened) for opened in await engine.maps()]
        return json_response(ListMapsResponse(maps=maps))

    @app.get("/maps/{ref}", response_model=MapInfo, responses=problems(404, 422, 500))
    async def get_map(ref: str) -> Response:
        """Describe one map: `id`, or `id@version`."""
        return json_response(MapInfo.from_map(await engine.map(ref)))

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
            await problem_response(internal_error(), id_)(scope, receive, send_with_id)
        finally:
            logger.info(
                "%s %r %d %.1f ms request_id=%s",
                *(scope["method"], scope["path"], status),
                *((perf_counter() - started) * 1000, id_),
            )


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


async def _on_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, VislocError)  # it is registered for these
    return problem_response(error, request.state.request_id)


async def _on_validation_error(request: Request, error: Exception) -> Response:
    """Say what FastAPI finds wrong in a path or a query in our words."""
    assert isinstance(error, RequestValidationError)
    return problem_response(refusal_of(error.errors()[0]), request.state.request_id)


async def _on_http_exception(request: Request, error: Exception) -> Response:
    """Say Starlette's own refusals, an unknown path or method, in our words."""
    assert isinstance(error, HTTPException)
    status = HTTPStatus(error.status_code)
    kind = NotFound if status == HTTPStatus.NOT_FOUND else InvalidInput
    code = "http." + status.phrase.lower().replace(" ", "_").replace("-", "_")
    refused = kind(code, status.phrase, got=f"{request.method} {request.url.path}")
    response = problem_response(refused, request.state.request_id, status)
    response.headers.update(error.headers or {})
    return response
