from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any

import httpx
import pytest
from fastapi import FastAPI
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from service.http.envelope import route_of
from service.http.health import metrics_app
from service.http.openapi.app import App
from service.telemetry.logs import UNMATCHED
from service.telemetry.metrics import Metrics, ServiceState
from service.telemetry.observer import Observer


def ask(app: Any, method: str, path: str) -> httpx.Response:
    async def run() -> httpx.Response:
        transport = httpx.ASGITransport(app)
        async with httpx.AsyncClient(transport=transport, base_url="http://here") as client:
            return await client.request(method, path)

    return asyncio.run(run())


@pytest.mark.parametrize(
    ("method", "path", "route"),
    [
        ("GET", "/maps/hall", "GET /maps/{ref}"),
        ("GET", "/maps/%0Aforged", "GET /maps/{ref}"),
        ("DELETE", "/maps/hall", "DELETE /maps/{ref}"),  # 405
        ("GET", "/nothing/of/ours", UNMATCHED),
        ("BREW", "/maps/hall", UNMATCHED),
    ],
)
def test_routes_are_templates_not_paths(method: str, path: str, route: str) -> None:
    app, routes = FastAPI(openapi_url=None), []

    @app.get("/maps/{ref}")
    async def get_map(ref: str) -> str:
        return ref

    async def watching(scope: Any, receive: Any, send: Any) -> None:
        await app(scope, receive, send)
        routes.append(route_of(scope))

    ask(watching, method, path)

    assert routes == [route]


def test_plain_routes_of_starlette_have_templates_too() -> None:
    routes = []

    async def endpoint(request: Request) -> Response:
        routes.append(route_of(request.scope))
        return Response()

    ask(Starlette(routes=[Route("/a/{b}", endpoint)]), "GET", "/a/c")

    assert routes == ["GET /a/{b}"]


def test_the_description_of_the_api_has_a_route() -> None:
    app, routes = App(docs_url=None), []
    app.openapi_schema = {"openapi": "3.1.0"}

    async def watching(scope: Any, receive: Any, send: Any) -> None:
        await app(scope, receive, send)
        routes.append(route_of(scope))

    assert ask(watching, "GET", "/openapi.json").json() == app.openapi_schema
    assert routes == ["GET /openapi.json"]


def test_the_port_of_metrics_answers_nothing_else() -> None:
    backend: Any = SimpleNamespace(
        observer=Observer(Metrics()), state=lambda: ServiceState(ready=True)
    )
    app = metrics_app(backend)
    found = ask(app, "GET", "/metrics")
    assert found.status_code == 200
    assert found.headers["content-type"] == "text/plain; version=0.0.4; charset=utf-8"
    assert "visloc_ready 1.0\n" in found.text
    for path in ("/", "/localize", "/maps", "/docs", "/openapi.json"):
        assert ask(app, "GET", path).status_code == 404
    assert ask(app, "POST", "/metrics").status_code == 405
