"""The OSCP GeoPose protocol: ``GET`` and ``POST /geopose``."""

from __future__ import annotations

from functools import partial
from http import HTTPStatus
from time import time

import numpy as np
from fastapi import FastAPI, Request
from numpy.typing import NDArray
from starlette.responses import Response

from service.api.answers import geoposes_to_words
from service.api.deadlines import within
from service.http.bodies import checked_media_type, parsed
from service.http.envelope import Backend, backend_of, limit_of
from service.http.openapi.app import problems
from service.http.responses import json_response, problem_response, while_connected
from service.security.access import LOCALIZING
from service.settings import ServiceSettings
from service.values import Localization, RigJob
from visloc.errors import InvalidInput, refuse
from visloc.geometry import Pose
from visloc.geopose import accuracy_of
from visloc_extensions.oscp.openapi import GEOPOSE_BODY, GEOPOSE_RESPONSES
from visloc_extensions.oscp.words import (
    GeoPoseAccuracy,
    GeoPoseRequest,
    GeoPoseResponse,
    GeoPoseStatus,
)

OSCP = "application/vnd.oscp+json"
OGC = "application/geopose+json"
JSON = "application/json"
_VERSIONS = {OSCP: ("1.0", "2.0"), OGC: ("1.0",), JSON: ()}
_READ = (JSON, OSCP)
# The protocol's word for an unknown accuracy.
UNKNOWN = -1.0
_MAX_ID = 200


def add_geopose_routes(app: FastAPI) -> None:
    """Add ``/geopose``."""
    LOCALIZING.add("geopose")
    app.get("/geopose", response_model=GeoPoseStatus, responses=problems(422))(geopose_status)
    app.post(
        "/geopose",
        response_model=GeoPoseResponse,
        responses={**problems(409, 413, 422, 429, 500, 503, 504), **GEOPOSE_RESPONSES},
        openapi_extra={"requestBody": GEOPOSE_BODY},
    )(geopose)


async def geopose_status() -> Response:
    """Tell that this server speaks the protocol."""
    return json_response(GeoPoseStatus())


async def geopose(request: Request) -> Response:
    """Find where on Earth a photo was taken: the OSCP GeoPose protocol, versions 1 and 2.

    The search covers the maps anchored around the latest geolocation reading; without one, those
    around the prior poses; without these, all maps. The answer is the pose of the camera of the
    first camera reading, as an OGC GeoPose of a body with x forward, y left, z up. With
    `Accept: application/geopose+json` it is the bare GeoPose. Photos of one rig and instant are
    localized together. A photo that cannot be localized is an error here, 404 with the code
    `geopose.not_localized`, because the protocol has no other word for it.
    """
    backend = backend_of(request)
    try:
        kind = answer_kind(request.headers.getlist("accept"))
    except InvalidInput as error:
        backend.observer.error(error)
        return problem_response(error, request.state.request_id, HTTPStatus.NOT_ACCEPTABLE)
    checked_media_type(request, _READ)
    limit = limit_of(request)
    backend.engine.check_room()
    async with backend.arrivals.body(request, backend.settings.max_batch_bytes) as body:
        asked, job = await parsed(body, partial(_read, body, settings=backend.settings))
    async with within(limit):
        work = _answer(backend, asked, job, request.state.request_id)
        answer = await while_connected(request.receive, work)
    if kind.partition(";")[0] == OGC:
        return Response(answer.geopose.model_dump_json(), media_type=kind)
    return Response(answer.model_dump_json(), media_type=kind)


def answer_kind(accept: list[str]) -> str:
    """Return the media type that the Accept headers prefer."""
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


def _read(body: bytes, settings: ServiceSettings) -> tuple[GeoPoseRequest, RigJob]:
    asked = GeoPoseRequest.read_json(body)
    return asked, asked.to_job(
        max_image_bytes=settings.max_image_bytes, max_images=settings.max_rig_images
    )


async def _answer(
    backend: Backend, asked: GeoPoseRequest, job: RigJob, request_id: str
) -> GeoPoseResponse:
    engine, observer = backend.engine, backend.observer
    if job.rig is None:
        found = await engine.localize(job)
        observer.localization(found)
    else:
        with engine.admit_batch():
            found = await engine.localize_rig(job)
        observer.instant(found)
    cam_from_world, covariance = _first_camera(found)
    map_ref = f"{found.map_id}@{found.map_version}"
    geopose, _ = geoposes_to_words(cam_from_world, found.geodetic, ypr=False)
    # An anchor that was given, not estimated, has no known accuracy.
    anchor = (await engine.map(map_ref)).outline.manifest.world.anchor
    if geopose is None or anchor is None or anchor.geodetic is None:
        # The map was chosen by its anchor, and then replaced by a version without one.
        raise refuse("geopose.not_anchored", ref=map_ref)
    accuracy = accuracy_of(cam_from_world, covariance, anchor)
    return GeoPoseResponse(
        id=(asked.id or request_id)[:_MAX_ID],
        timestamp=round(time() * 1000) if asked.timestamp is None else asked.timestamp,
        accuracy=GeoPoseAccuracy(
            position=UNKNOWN if anchor.rms is None else accuracy.position,
            orientation=accuracy.orientation,
        ),
        geopose=geopose,
    )


def _first_camera(found: Localization) -> tuple[Pose, NDArray[np.float64]]:
    """Return the pose and covariance (6, 6) of the camera of the first reading."""
    pose, refusal = found.answer.pose, found.answer.refusal
    if pose is None:
        assert refusal is not None  # an instant has a pose or a refusal
        raise refuse(
            "geopose.not_localized", refusal.message, got=f"{refusal.stage}: {refusal.reason}"
        )
    cam_from_rig = found.answer.images[0].cam_from_rig
    # C Exp(w) R = Exp(C w) C R and C (t + dt) + c: both parts turn with the camera.
    turn = np.kron(np.eye(2), cam_from_rig.rotation)
    return cam_from_rig @ pose.rig_from_world, turn @ pose.covariance @ turn.T
