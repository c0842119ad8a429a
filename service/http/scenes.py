"""Landmarks and mapping images of maps over HTTP, for the page and other viewers."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Annotated, Any

from fastapi import FastAPI, Query, Request, Response

from service.api.deadlines import within
from service.api.maps import map_images
from service.engine.engine import Engine
from service.http.cache_headers import (
    ASK_ALWAYS_PRIVATE,
    FOR_EVER_PRIVATE,
    is_current,
    not_modified,
)
from service.http.envelope import backend_of, limit_of
from service.http.openapi.app import problems
from visloc.archive import MapOutline, SetOutline
from visloc.archive.checks import is_set
from visloc.errors import NotFound
from visloc_api.words.scenes import MapImages

MAX_POINTS, MAX_IMAGES = 262_144, 10_000

_BINARY = "application/octet-stream"
_CACHED: dict[int | str, dict[str, Any]] = {304: {"description": "as `If-None-Match` names it"}}
_POINTS: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "a header of 48 bytes and 16 bytes per landmark (docs/api.md)",
        "content": {_BINARY: {"schema": {"type": "string", "format": "binary"}}},
    }
}

First = Annotated[int, Query(ge=0, lt=2**32, description="place in the order to begin at")]


class _Binary(Response):
    media_type = _BINARY


def add_scene_routes(app: FastAPI) -> None:
    """Add the routes of landmarks and mapping images."""
    refusals = problems(404, 422, 500, 503, 504)
    app.get(
        "/maps/{ref}/points",
        response_class=_Binary,
        responses={**_POINTS, **_CACHED, **refusals},
    )(get_points)
    app.get("/maps/{ref}/images", response_model=MapImages, responses={**_CACHED, **refusals})(
        get_images
    )


async def get_points(
    request: Request,
    ref: str,
    first: First = 0,
    count: Annotated[int, Query(ge=1, le=MAX_POINTS, description="most landmarks")] = 65_536,
) -> Response:
    """Give landmarks of a map (`id`, or `id@version`), in an order of detail.

    Every prefix of the order samples the map evenly in space: the more is read, the finer the
    detail. With `id@version` the answer may be cached for ever.
    """
    engine = backend_of(request).engine

    async def answer(outline: MapOutline) -> Response:
        headers = _caching(outline, ref, first, count)
        if is_current(request.headers, headers["ETag"]):
            return not_modified(headers)
        body = await engine.scenes.points(outline, first, count)
        return Response(body, headers=headers, media_type=_BINARY)

    async with within(limit_of(request)):
        return await _of_version(engine, ref, answer)


async def get_images(
    request: Request,
    ref: str,
    first: First = 0,
    count: Annotated[int, Query(ge=1, le=MAX_IMAGES, description="most photos")] = 1000,
) -> Response:
    """Give the poses of the mapping images of a map (`id`, or `id@version`)."""
    engine = backend_of(request).engine

    async def answer(outline: MapOutline) -> Response:
        headers = _caching(outline, ref, first, count)
        if is_current(request.headers, headers["ETag"]):
            return not_modified(headers)
        photos = await engine.scenes.photos(outline)
        text = await asyncio.to_thread(
            lambda: map_images(outline, photos, first, count).model_dump_json()
        )
        return Response(text, headers=headers, media_type="application/json")

    async with within(limit_of(request)):
        return await _of_version(engine, ref, answer)


async def _of_version(
    engine: Engine, ref: str, answer: Callable[[MapOutline], Awaitable[Response]]
) -> Response:
    """Answer with the version that ``ref`` names."""
    outline = _of_map((await engine.map(ref)).outline)
    try:
        return await answer(outline)
    except NotFound:
        now = _of_map((await engine.map(ref)).outline)
        if now.ref == outline.ref:
            raise
        return await answer(now)  # a new version became current, and the old one was deleted


def _of_map(outline: MapOutline | SetOutline) -> MapOutline:
    """Refuse a set: its landmarks and images belong to its tiles (``map.is_set``)."""
    if isinstance(outline, SetOutline):
        raise is_set(outline.ref, outline.manifest)
    return outline


def _caching(outline: MapOutline, ref: str, first: int, count: int) -> dict[str, str]:
    """Return the headers that say how long a part of a map may be cached."""
    manifest = outline.manifest
    return {
        # The content hash does not cover the version, which answers name.
        "ETag": f'"{manifest.version}-{manifest.content_hash[:32]}-{first}-{count}"',
        "Cache-Control": FOR_EVER_PRIVATE if "@" in ref else ASK_ALWAYS_PRIVATE,
        # A cache must not give the answer to callers with another key or none.
        "Vary": "Authorization, X-API-Key",
    }
