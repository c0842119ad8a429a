"""Maps over HTTP: what there is, and versions that come, take over and go."""

from __future__ import annotations

import asyncio
from contextlib import aclosing
from typing import Annotated, Any

from fastapi import FastAPI, Query, Request, Response

from service.api import ListMapsResponse, MapInfo
from service.api.geopose import near_from_text
from service.engine.engine import Engine
from service.http.bodies import checked_media_type, read_use_version
from service.http.openapi.app import problems
from service.http.responses import json_response
from service.http.slow_clients import arrivals_of
from service.settings import ServiceSettings
from visloc.errors import refuse

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


def add_map_routes(app: FastAPI, engine: Engine, settings: ServiceSettings) -> None:
    """Add the routes below /maps."""

    @app.get("/maps", response_model=ListMapsResponse, responses=problems(422))
    async def list_maps(
        near: Annotated[
            str | None,
            Query(
                description="latitude,longitude,radius (degrees, metres, WGS84): only the maps "
                "that are anchored to the Earth and reach into this circle"
            ),
        ] = None,
    ) -> Response:
        """List the maps that can be opened, in the version that is served; sets of maps too."""
        circle = None if near is None else near_from_text(near).to_core()
        listed = await engine.maps(circle)

        def answer() -> Response:
            maps = [MapInfo.from_served(served, in_list=True) for served in listed]
            return json_response(ListMapsResponse(maps=maps))

        # Of ten thousand maps, it takes a moment.
        return await asyncio.to_thread(answer)

    @app.get("/maps/{ref}", response_model=MapInfo, responses=problems(404, 422, 500))
    async def get_map(ref: str) -> Response:
        """Describe one map: `id`, or `id@version`."""
        return json_response(await asyncio.to_thread(MapInfo.from_served, await engine.map(ref)))

    @app.post(
        "/maps/{map_id}/current",
        response_model=MapInfo,
        responses=problems(404, 409, 413, 422, 500, 503),
        openapi_extra={"requestBody": _USE_VERSION_BODY},
    )
    async def use_version(map_id: str, request: Request) -> Response:
        """Put a version into use, a newer or an older one, once the server has it open and warm.

        Requests that are under way are answered by the version that they began with.
        """
        asked = await read_use_version(request)
        served = await engine.set_current(map_id, asked.version)
        return json_response(MapInfo.from_served(served))

    path = "/maps/{map_id}/versions/{version}"

    @app.get(path, response_model=MapInfo, responses=problems(404, 422, 500))
    async def get_version(map_id: str, version: str) -> Response:
        """Describe one version, published but not necessarily in use."""
        served = await engine.map(f"{map_id}@{version}")
        return json_response(await asyncio.to_thread(MapInfo.from_served, served))

    @app.put(
        path,
        status_code=201,
        response_model=MapInfo,
        responses=problems(409, 413, 422, 429, 500, 503, 504, 507),
        openapi_extra={"requestBody": _PACKED_BODY},
    )
    async def put_version(map_id: str, version: str, request: Request) -> Response:
        """Publish a version from its packed file.

        It is verified byte by byte before anyone can see it, and is not in use until
        `POST /maps/{map_id}/current` names it.
        """
        checked_media_type(request, _PACKED)
        _check_declared_size(request, settings)
        async with aclosing(arrivals_of(request).chunks(request)) as chunks:
            served = await engine.upload(map_id, version, chunks)
        response = json_response(MapInfo.from_served(served), 201)
        response.headers["Location"] = f"/maps/{map_id}/versions/{version}"
        return response

    @app.delete(path, status_code=204, responses=problems(404, 409, 422, 500, 503))
    async def delete_version(map_id: str, version: str) -> Response:
        """Delete a version that is not in use, or the last one there is."""
        await engine.delete(map_id, version)
        return Response(status_code=204)


def _check_declared_size(request: Request, settings: ServiceSettings) -> None:
    declared = request.headers.get("content-length", "")
    if declared.isdecimal() and int(declared[:20]) > settings.max_upload_bytes:
        raise refuse(
            "request.too_large",
            "the packed map has too many bytes",
            expected=f"at most {settings.max_upload_bytes} bytes",
            got=f"{declared[:20]} bytes",
        )
