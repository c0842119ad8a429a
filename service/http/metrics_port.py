"""The separate port for Prometheus: only ``/metrics``, without an API key."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

# The text of a scrape and its content type.
Render = Callable[[], Awaitable[tuple[bytes, str]]]


def metrics_app(render: Render) -> Starlette:
    """Make the app of the separate port."""

    async def metrics(request: Request) -> Response:
        del request
        return await metrics_response(render)

    return Starlette(routes=[Route("/metrics", metrics)])


async def metrics_response(render: Render) -> Response:
    """Answer a scrape."""
    body, content_type = await render()
    return Response(body, headers={"Content-Type": content_type, "Cache-Control": "no-store"})
