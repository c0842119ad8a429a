"""The OSCP GeoPose protocol: ``GET`` and ``POST /geopose``."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from http import HTTPStatus
from time import time

import numpy as np
from fastapi import FastAPI, Request
from numpy.typing import NDArray
from starlette.responses import Response

from service.api.deadlines import TIMEOUT_HEADER, timeout_of, within
from service.api.geopose import geoposes_to_words
from service.api.oscp import (
    GeoPoseAccuracy,
    GeoPoseRequest,
    GeoPoseResponse,
    GeoPoseStatus,
)
from service.engine.engine import Engine
from service.http.bodies import checked_media_type
from service.http.openapi.app import problems
from service.http.oscp.examples import GEOPOSE_BODY, GEOPOSE_RESPONSES
from service.http.responses import json_response, problem_response, while_connected
from service.http.slow_clients import arrivals_of
from service.settings import ServiceSettings
from service.telemetry.observer import Observer
from service.values import InstantLocalization, Localization, LocalizeJob, RigJob
from visloc.archive import Geodetic
from visloc.errors import InvalidInput, VislocError, refuse
from visloc.geometry import Pose
from visloc.geopose import accuracy_of
from visloc.types import Localized

OSCP = "application/vnd.oscp+json"
OGC = "application/geopose+json"
JSON = "application/json"
_VERSIONS = {OSCP: ("1.0", "2.0"), OGC: ("1.0",), JSON: ()}
_READ = (JSON, OSCP)
# The protocol's accuracy where it is not known.
UNKNOWN = -1.0
_MAX_ID = 200


def add_geopose_routes(app: FastAPI, engine: Engine, settings: ServiceSettings) -> None:
    """Serve the protocol. The state of the app has its observer and its arrivals."""

    @app.get("/geopose", response_model=GeoPoseStatus)
    async def geopose_status() -> Response:
        """Tell that the protocol is spoken here."""
        return json_response(GeoPoseStatus())

    @app.post(
        "/geopose",
        response_model=GeoPoseResponse,
        responses={
            **problems(409, 413, 422, 429, 500, 503, 504),
            **GEOPOSE_RESPONSES,
        },
        openapi_extra={"requestBody": GEOPOSE_BODY},
    )
    async def geopose(request: Request) -> Response:
        """Find where on Earth a photo was taken: the OSCP GeoPose protocol, versions 1 and 2.

        It searches the maps that are anchored around the request's latest geolocation reading (else
        its prior poses, else all). The answer is the pose of the camera of the first camera
        reading, as an OGC GeoPose of a body with x forward, y left, z up; with
        `Accept: application/geopose+json` it is the bare GeoPose. Photos of one rig and instant are
        localized together. A photo that cannot be localized is an error here, 404 with the code
        `geopose.not_localized`, as the protocol has no other word for it.
        """
        observer: Observer = request.app.state.observer
        try:
            kind = answer_kind(request.headers.getlist("accept"))
        except InvalidInput as error:
            observer.error(error)
            return problem_response(error, request.state.request_id, HTTPStatus.NOT_ACCEPTABLE)
        checked_media_type(request, _READ)
        timeout_s = timeout_of(request.headers.get(TIMEOUT_HEADER), settings.request_timeout_s)
        engine.check_room()
        async with arrivals_of(request).body(request, settings.max_batch_bytes) as body:
            asked, job = await asyncio.to_thread(_read, body, settings)
        async with within(timeout_s):
            work = _answer(engine, observer, asked, job, request.state.request_id)
            answer = await while_connected(request.receive, work)
        if kind.partition(";")[0] == OGC:
            return Response(answer.geopose.model_dump_json(), media_type=kind)
        return Response(answer.model_dump_json(), media_type=kind)


def answer_kind(accept: list[str]) -> str:
    """Return the media type of the answer that the Accept headers like best.

    Raises:
        InvalidInput: ``geopose.accept`` when they allow none that is given here.
    """
    ranges = [one for header in accept for one in header.split(",") if one.strip()]
    best, best_quality = JSON if not ranges else None, 0.0
    for one in ranges:
        name, *parameters = (part.strip() for part in one.lower().split(";"))
        given = dict(part.split("=", 1) for part in parameters if "=" in part)
        values = {key.strip(): value.strip(' "') for key, value in given.items()}
        kind = JSON if name in ("*/*", "application/*") else name
        version = values.get("version")
        try:
            quality = float(values.get("q", "1"))
        except ValueError:
            quality = 0.0
        if kind not in _VERSIONS or not quality > best_quality:
            continue
        if version is not None and kind != JSON:
            if version not in _VERSIONS[kind]:
                continue
            kind = f"{kind}; version={version}"
        best, best_quality = kind, quality
    if best is None:
        raise refuse(
            "geopose.accept",
            field="Accept",
            expected=f"{OSCP}; version=1.0 or 2.0, {OGC}, {JSON}, or nothing",
            got=", ".join(accept),
        )
    return best


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """The pose of the camera of the first reading."""

    cam_from_world: Pose
    covariance: NDArray[np.float64]
    geodetic: Geodetic | None
    map_ref: str


def _read(body: bytes, settings: ServiceSettings) -> tuple[GeoPoseRequest, LocalizeJob | RigJob]:
    asked = GeoPoseRequest.read_json(body)
    return asked, asked.to_job(
        max_image_bytes=settings.max_image_bytes, max_images=settings.max_rig_images
    )


async def _answer(
    engine: Engine,
    observer: Observer,
    asked: GeoPoseRequest,
    job: LocalizeJob | RigJob,
    request_id: str,
) -> GeoPoseResponse:
    if isinstance(job, RigJob):
        with engine.admit_batch():
            instant = await engine.localize_rig(job)
        observer.instant(instant)
        found = _of_rig(instant)
    else:
        localization = await engine.localize(job)
        observer.localization(localization)
        found = _of_photo(localization)
    geopose, _ = geoposes_to_words(found.cam_from_world, found.geodetic, ypr=False)
    if geopose is None or found.geodetic is None:
        # Found by its anchor, and replaced by a version without one in that moment.
        raise refuse("geopose.not_anchored", ref=found.map_ref)
    # Of a place that was simply given, nobody knows how exact it is.
    anchor = (await engine.map(found.map_ref)).outline.manifest.world.anchor
    accuracy = accuracy_of(
        found.cam_from_world,
        found.covariance,
        found.geodetic,
        None if anchor is None else anchor.rms,
    )
    return GeoPoseResponse(
        id=(asked.id or request_id)[:_MAX_ID],
        timestamp=round(time() * 1000) if asked.timestamp is None else asked.timestamp,
        accuracy=GeoPoseAccuracy(
            position=UNKNOWN if anchor is None or anchor.rms is None else accuracy.position,
            orientation=accuracy.orientation,
        ),
        geopose=geopose,
    )


def _of_photo(found: Localization) -> _Found:
    answer = found.answer
    if not isinstance(answer, Localized):
        raise _not_localized(answer.stage, answer.reason, answer.message)
    ref = f"{found.map_id}@{found.map_version}"
    return _Found(answer.cam_from_world, answer.covariance, found.geodetic, ref)


def _of_rig(found: InstantLocalization) -> _Found:
    pose, refusal = found.answer.pose, found.answer.refusal
    if pose is None:
        assert refusal is not None  # an instant has one of both
        raise _not_localized(refusal.stage, refusal.reason, refusal.message)
    cam_from_rig = found.answer.images[0].cam_from_rig
    cam_from_world = cam_from_rig @ pose.rig_from_world
    # C Exp(w) R = Exp(C w) C R and C (t + dt) + c: both parts turn with the camera.
    turn = np.kron(np.eye(2), cam_from_rig.rotation)
    covariance = turn @ pose.covariance @ turn.T
    ref = f"{found.map_id}@{found.map_version}"
    return _Found(cam_from_world, covariance, found.geodetic, ref)


def _not_localized(stage: str, reason: str, message: str) -> VislocError:
    return refuse("geopose.not_localized", message, got=f"{stage}: {reason}")
