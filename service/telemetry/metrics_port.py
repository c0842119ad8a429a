"""The port of its own for Prometheus: nothing but ``/metrics``, and no key needed."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

# The text of a scrape and its content type.
Render = Callable[[], Awaitable[tuple[bytes, str]]]


def metrics_app(render: Render) -> Starlette:
    """Make the application; ``render`` is asked for every scrape."""

    async def metrics(request: Request) -> Response:
        del request  # it says nothing
        return await metrics_response(render)

    return Starlette(routes=[Route("/metrics", metrics)])


async def metrics_response(render: Render) -> Response:
    """Answer a scrape."""
    body, content_type = await render()
    return Response(body, headers={"Content-Type": content_type, "Cache-Control": "no-store"})
