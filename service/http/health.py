"""Health, readiness and metrics over HTTP."""

from __future__ import annotations

import asyncio

from fastapi import FastAPI, Request, Response
from fastapi.responses import PlainTextResponse
from starlette.applications import Starlette
from starlette.routing import Route

import visloc
from service.http.access import tokens_in
from service.http.envelope import Backend, backend_of
from service.http.responses import json_response
from service.security.access import READ
from visloc_api.words.status import Health, MapNotLoaded, Readiness


def add_health_routes(app: FastAPI) -> None:
    """Add ``/healthz``, ``/readyz`` and ``/metrics``."""
    app.get("/healthz", response_model=Health)(healthz)
    app.get("/readyz", response_model=Readiness, responses={503: {"model": Readiness}})(readyz)
    app.get(
        "/metrics",
        response_class=PlainTextResponse,
        responses={200: {"content": {"text/plain": {}}, "description": "Prometheus metrics"}},
    )(metrics)


def metrics_app(backend: Backend) -> Starlette:
    """Make the app of the separate port for Prometheus: only ``/metrics``, without an API key."""
    app = Starlette(routes=[Route("/metrics", metrics)])
    app.state.backend = backend
    return app


async def healthz() -> Response:
    """Tell that the process answers."""
    return json_response(Health(version=visloc.__version__))


async def readyz(request: Request) -> Response:
    """Tell whether maps and networks are warm: 200, or 503 while they are not.

    It needs no key, but names maps only to a key with the scope `read`.
    """
    backend = backend_of(request)
    status = backend.engine.status
    if not backend.access.may(tokens_in(request.headers), READ):
        return _answer(Readiness(ready=status.ready, maps=[], not_loaded=[]))
    not_loaded = [
        MapNotLoaded(id=map_id, code=error.code, message=str(error))
        for map_id, error in status.not_loaded.items()
    ]
    readiness = Readiness(ready=status.ready, maps=list(status.maps), not_loaded=not_loaded)
    return _answer(readiness)


def _answer(readiness: Readiness) -> Response:
    return json_response(readiness, 200 if readiness.ready else 503)


async def metrics(request: Request) -> Response:
    """Report the state of the service to Prometheus."""
    backend = backend_of(request)
    render = backend.observer.metrics.render
    body, content_type = await asyncio.to_thread(render, backend.state())
    return Response(body, headers={"Content-Type": content_type, "Cache-Control": "no-store"})
