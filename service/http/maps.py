"""Maps over HTTP: list, describe, publish, activate and delete versions."""

from __future__ import annotations

import asyncio
from contextlib import aclosing
from typing import Annotated, Any

from fastapi import FastAPI, Query, Request, Response

from service.api.maps import map_info
from service.http.bodies import checked_media_type, read_use_version
from service.http.envelope import backend_of
from service.http.openapi.app import problems
from service.http.responses import json_response
from visloc.errors import refuse
from visloc_api.words.maps import ListMapsResponse, MapInfo
from visloc_api.words.near import near_from_text

_PACKED = ("application/zip", "application/octet-stream")
_PACKED_BODY: dict[str, Any] = {
    "required": True,
    "description": "the file that `mapping pack` wrote",
    "content": {kind: {"schema": {"type": "string", "format": "binary"}} for kind in _PACKED},
}
_USE_VERSION_BODY: dict[str, Any] = {
    "required": True,
    "content": {
        "application/json": {
            "schema": {"$ref": "#/components/schemas/UseVersionRequest"},
            "examples": {"use": {"value": {"version": "20261121T111436.881Z-7f9cafe0"}}},
        }
    },
}


def add_map_routes(app: FastAPI) -> None:
    """Add the routes of maps and their versions."""
    version = "/maps/{map_id}/versions/{version}"
    app.get("/maps", response_model=ListMapsResponse, responses=problems(422))(list_maps)
    app.get("/maps/{ref}", response_model=MapInfo, responses=problems(404, 422, 500))(get_map)
    app.post(
        "/maps/{map_id}/current",
        response_model=MapInfo,
        responses=problems(404, 409, 413, 422, 500, 503),
        openapi_extra={"requestBody": _USE_VERSION_BODY},
    )(use_version)
    app.get(version, response_model=MapInfo, responses=problems(404, 422, 500))(get_version)
    app.put(
        version,
        status_code=201,
        response_model=MapInfo,
        responses=problems(409, 413, 422, 429, 500, 503, 504, 507),
        openapi_extra={"requestBody": _PACKED_BODY},
    )(put_version)
    app.delete(version, status_code=204, responses=problems(404, 409, 422, 500, 503))(
        delete_version
    )


async def list_maps(
    request: Request,
    near: Annotated[
        str | None,
        Query(
            description="latitude,longitude,radius (degrees, metres, WGS84): only the maps that "
            "are anchored to the Earth and reach into this circle"
        ),
    ] = None,
) -> Response:
    """List the maps and sets of maps that can be opened, each in its current version."""
    circle = None if near is None else near_from_text(near).to_core()
    listed = await backend_of(request).engine.maps(circle)

    def answer() -> Response:
        maps = tuple(map_info(served, in_list=True) for served in listed)
        return json_response(ListMapsResponse(maps=maps))

    return await asyncio.to_thread(answer)  # slow for ten thousand maps


async def get_map(request: Request, ref: str) -> Response:
    """Describe one map: `id`, or `id@version`."""
    served = await backend_of(request).engine.map(ref)
    return json_response(await asyncio.to_thread(map_info, served))


async def use_version(map_id: str, request: Request) -> Response:
    """Make a version current, newer or older, once the server has opened and warmed it.

    Requests that are being served finish with the version that they started with.
    """
    asked = await read_use_version(request)
    served = await backend_of(request).engine.set_current(map_id, asked.version)
    return json_response(map_info(served))


async def get_version(request: Request, map_id: str, version: str) -> Response:
    """Describe one published version, current or not."""
    return await get_map(request, f"{map_id}@{version}")


async def put_version(map_id: str, version: str, request: Request) -> Response:
    """Publish a version from its packed file.

    Every byte is verified before the version becomes visible. It is not used until
    `POST /maps/{map_id}/current` names it.
    """
    backend = backend_of(request)
    checked_media_type(request, _PACKED)
    _check_declared_size(request, backend.settings.max_upload_bytes)
    async with aclosing(backend.arrivals.chunks(request)) as chunks:
        served = await backend.engine.upload(map_id, version, chunks)
    response = json_response(map_info(served), 201)
    response.headers["Location"] = f"/maps/{map_id}/versions/{version}"
    return response


async def delete_version(request: Request, map_id: str, version: str) -> Response:
    """Delete a version that is not current, or the last version of a map."""
    await backend_of(request).engine.delete(map_id, version)
    return Response(status_code=204)


def _check_declared_size(request: Request, limit: int) -> None:
    declared = request.headers.get("content-length", "")
    if declared.isdecimal() and int(declared[:20]) > limit:
        raise refuse(
            "request.too_large",
            "the packed map has too many bytes",
            expected=f"at most {limit} bytes",
            got=f"{declared[:20]} bytes",
        )
