"""The ASGI app of the HTTP API."""

from __future__ import annotations

from http import HTTPStatus

from fastapi import Depends, Request, Response
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Receive, Scope, Send

import visloc
from service.http.access import add_access
from service.http.envelope import PROBED_PATHS, Backend, RequestEnvelope, backend_of
from service.http.health import add_health_routes
from service.http.localize import add_localize_routes
from service.http.maps import add_map_routes
from service.http.openapi.app import App
from service.http.responses import problem_response
from service.http.scenes import add_scene_routes
from service.http.static_page import add_page_routes
from visloc.errors import InvalidInput, NotFound, VislocError, refuse
from visloc.extensions import HTTP_ROUTES, extensions, load
from visloc_api.words.json_text import MAX_NAME
from visloc_api.words.message import refusal_of


def create_app(backend: Backend) -> App:
    """Make the app. The caller starts and closes the engine."""
    app = App(
        title="visloc",
        version=visloc.__version__,
        summary="Localizes photos in maps of posed photos.",
        docs_url=None,  # loads scripts from another host; ours are in static_page
        redoc_url=None,
        redirect_slashes=False,  # the target would be built from the caller's Host header
        dependencies=[Depends(_check_query)],
    )
    app.state.backend = backend
    settings = backend.settings
    app.add_middleware(HeadAsGet)
    add_access(app, backend.access, backend.observer, page=settings.page)
    app.add_middleware(RequestEnvelope, backend=backend)
    app.add_exception_handler(VislocError, _on_error)
    app.add_exception_handler(RequestValidationError, _on_validation_error)
    app.add_exception_handler(HTTPException, _on_http_exception)
    add_localize_routes(app)
    add_health_routes(app)
    add_map_routes(app)
    add_scene_routes(app)
    for entry in extensions(HTTP_ROUTES).values():
        load(entry)(app)
    if settings.page:
        add_page_routes(app)
    return app


class HeadAsGet:
    """Serves HEAD as GET. uvicorn sends no body."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self._app(scope, receive, send)
            return
        as_get = {**scope, "method": "GET"}  # uvicorn looks at the original
        try:
            await self._app(as_get, receive, send)
        finally:
            scope["route"] = as_get.get("route")  # for the log


async def _check_query(request: Request) -> None:
    """Refuse query parameters that would be ignored. Pages and probes may have any."""
    route = request.scope["route"]
    if not route.include_in_schema or route.path in PROBED_PATHS:
        return
    known = [field.alias for field in route.dependant.query_params]
    seen: set[str] = set()
    for name, _ in request.query_params.multi_items():
        if name not in known:
            raise refuse(
                "request.unknown_field",
                "this path does not have this query parameter",
                field=name[:MAX_NAME],
                expected=known or "no query string: fields of a request are in its body",
                got=name,
            )
        if name in seen:
            raise refuse("request.duplicate_field", field=name)
        seen.add(name)


def _refused(request: Request, error: VislocError, status: HTTPStatus | None = None) -> Response:
    backend_of(request).observer.error(error)
    return problem_response(error, request.state.request_id, status)


async def _on_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, VislocError)  # registered for these only
    return _refused(request, error)


async def _on_validation_error(request: Request, error: Exception) -> Response:
    """Turn FastAPI's refusal of a path or query parameter into a problem of ours."""
    assert isinstance(error, RequestValidationError)
    return _refused(request, refusal_of(error.errors()[0]))


async def _on_http_exception(request: Request, error: Exception) -> Response:
    """Turn Starlette's refusal of a path or method into a problem of ours."""
    assert isinstance(error, HTTPException)
    status = HTTPStatus(error.status_code)
    kind = NotFound if status == HTTPStatus.NOT_FOUND else InvalidInput
    name = status.phrase.lower().replace(" ", "_").replace("-", "_")
    asked = f"{request.method} {request.url.path}"
    refused = refuse(f"http.{name}", status.phrase, got=asked, kind=kind)
    response = _refused(request, refused, status)
    response.headers.update(error.headers or {})
    return response
