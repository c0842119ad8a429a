"""Localization over HTTP: photos, rigs and sequences."""

from __future__ import annotations

import json
from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import aclosing
from functools import partial

from fastapi import FastAPI, Request, Response

from service.api.answers import instant_answer, localize_response
from service.api.deadlines import TimeLimit, each_within, within
from service.engine.engine import Engine
from service.http.bodies import read_localize_job, read_rig_job, read_sequence_jobs
from service.http.envelope import backend_of, limit_of
from service.http.openapi.app import problems
from service.http.openapi.request_bodies import LOCALIZE_BODY, RIG_BODY, SEQUENCE_BODY
from service.http.responses import Lines, json_response, while_connected
from service.telemetry.observer import Observer
from service.values import InstantJob, Localization, SequenceJob
from visloc_api.words.answers import InstantAnswer, LocalizeResponse, LocalizeSequenceResponse
from visloc_api.words.wire import NDJSON


def add_localize_routes(app: FastAPI) -> None:
    """Add the routes below ``/localize``."""
    responses = problems(404, 409, 413, 422, 429, 500, 503, 504)
    app.post(
        "/localize",
        response_model=LocalizeResponse,
        responses=responses,
        openapi_extra={"requestBody": LOCALIZE_BODY},
    )(localize)
    app.post(
        "/localize/rig",
        response_model=InstantAnswer,
        responses=responses,
        openapi_extra={"requestBody": RIG_BODY},
    )(localize_rig)
    app.post(
        "/localize/sequence",
        response_model=LocalizeSequenceResponse,
        responses=responses,
        openapi_extra={"requestBody": SEQUENCE_BODY},
    )(localize_sequence)


async def localize(request: Request) -> Response:
    """Estimate the camera pose of one photo, or of its features, in one map.

    A photo that cannot be localized is an answer (`status: not_localized`), not an error.
    """
    backend, limit = backend_of(request), limit_of(request)
    backend.engine.check_room()
    job = await read_localize_job(request)
    async with within(limit):
        found = await while_connected(request.receive, backend.engine.localize(job))
    backend.observer.localization(found)
    return json_response(localize_response(found, request.state.request_id))


async def localize_rig(request: Request) -> Response:
    """Estimate one pose from photos that the cameras of a rig took at the same time.

    A photo that cannot be used fails alone: the others are still localized.
    """
    backend, limit = backend_of(request), limit_of(request)
    job = await read_rig_job(request)
    with backend.engine.admit_batch():
        async with within(limit):
            found = await while_connected(request.receive, backend.engine.localize_rig(job))
    backend.observer.instant(found)
    return json_response(instant_answer(found, request.state.request_id))


async def localize_sequence(request: Request) -> Response:
    """Estimate the poses of a rig, or of one camera, at the instants of a sequence.

    With `Accept: application/x-ndjson` each answer is one line, sent as soon as it is final.
    """
    backend, limit = backend_of(request), limit_of(request)
    start, instants = await read_sequence_jobs(request)
    answers = _observed(_admitted(backend.engine, start, instants), limit, backend.observer)
    id_ = request.state.request_id
    message = partial(instant_answer, request_id=id_)
    if _wants_lines(request):
        first = await while_connected(request.receive, _next_of(answers))
        return Lines(first, answers, message, id_, backend.settings.arrival_timeout_s)
    texts = await while_connected(request.receive, _texts_of(answers, message))
    return _sequence_response(texts, id_)


async def _next_of(answers: AsyncGenerator[Localization]) -> Localization:
    return await anext(answers)


async def _texts_of(
    answers: AsyncGenerator[Localization],
    message: Callable[[Localization], InstantAnswer],
) -> list[bytes]:
    # An answer takes seven times the memory of its text.
    async with aclosing(answers):
        return [message(answer).model_dump_json().encode() async for answer in answers]


def _sequence_response(texts: Sequence[bytes], id_: str) -> Response:
    body = b'{"request_id":%b,"answers":[%b]}' % (json.dumps(id_).encode(), b",".join(texts))
    return Response(body, media_type="application/json")


def _wants_lines(request: Request) -> bool:
    accepted = ",".join(request.headers.getlist("accept")).lower().split(",")
    return any(kind.partition(";")[0].strip() == NDJSON for kind in accepted)


async def _admitted(
    engine: Engine, start: SequenceJob, instants: Sequence[InstantJob]
) -> AsyncGenerator[Localization]:
    with engine.admit_batch():
        async with aclosing(engine.localize_sequence(start, instants)) as answers:
            async for answer in answers:
                yield answer


async def _observed(
    answers: AsyncGenerator[Localization], limit: TimeLimit, observer: Observer
) -> AsyncGenerator[Localization]:
    """Pass answers on, each within the timeout, and report them."""
    async with aclosing(answers), aclosing(each_within(limit, answers)) as timed:
        async for answer in timed:
            observer.instant(answer)
            yield answer
