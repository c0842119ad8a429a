"""Access control of HTTP requests."""

from __future__ import annotations

from contextlib import ExitStack
from http import HTTPStatus

from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.middleware.cors import CORSMiddleware
from starlette.responses import Response
from starlette.routing import Match
from starlette.types import ASGIApp, Receive, Scope, Send

from service.http.responses import problem_response
from service.security.access import Access, needed_over_http, tokens_of
from service.security.key_file import Key
from service.telemetry.observer import Observer
from visloc.errors import VislocError
from visloc_api.words.wire import MAP_HEADER, TIMEOUT_HEADER


def add_access(app: Starlette, access: Access, observer: Observer, *, page: bool = False) -> None:
    """Add access control to an app, and CORS around it if other origins may call.

    Call this before the envelope is added, which must be outermost: it gives requests their ids.

    Args:
        observer: learns of refusals.
        page: whether the app serves the files of the page, which need no key.
    """
    app.add_middleware(AccessControl, access=access, observer=observer, page=page)
    if access.origins:
        app.add_middleware(
            CORSMiddleware,
            allow_origins=sorted(access.origins),
            allow_methods=["GET", "HEAD", "POST", "PUT", "DELETE"],
            allow_headers=[
                *("Authorization", "X-API-Key", "X-Request-ID", TIMEOUT_HEADER, MAP_HEADER),
                "traceparent",
            ],
            expose_headers=["Location", "Retry-After", "X-Request-ID"],
            allow_private_network=True,  # Starlette would refuse preflights that ask for it
        )


def tokens_in(headers: Headers) -> set[str]:
    """Return the API keys that a request carries."""
    return tokens_of(headers.getlist("authorization"), headers.getlist("x-api-key"))


class AccessControl:
    """Admits or refuses a request before any of its body is read."""

    def __init__(self, app: ASGIApp, access: Access, observer: Observer, *, page: bool) -> None:
        self._app = app
        self._access = access
        self._observer = observer
        self._page = page

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        key = None
        with ExitStack() as stack:
            try:
                host, origins = headers.get("host", ""), headers.getlist("origin")
                self._access.check_page(scope["scheme"], host, origins)
                tokens = tokens_in(headers)
                needed = needed_over_http(scope["method"], scope["path"], page=self._page)
                key = self._access.key_of(tokens, needed)
                stack.enter_context(self._access.place(key))
            except VislocError as error:
                self._observer.error(error)
                _note_route(scope)
                response = self._refusal(error, scope["state"]["request_id"], key)
                await response(scope, receive, send)
                return
            await self._app(scope, receive, send)

    def _refusal(self, error: VislocError, id_: str, key: Key | None) -> Response:
        response = problem_response(error, id_)
        if response.status_code == HTTPStatus.UNAUTHORIZED:
            response.headers["WWW-Authenticate"] = 'Bearer realm="visloc"'
        if response.status_code == HTTPStatus.TOO_MANY_REQUESTS:
            response.headers["Retry-After"] = str(self._access.wait_s(key))
        return response


def _note_route(scope: Scope) -> None:
    """Record the route of a refused request for the log, because the app never sees it."""
    for route in scope["app"].routes:
        if route.matches(scope)[0] is Match.FULL:
            scope["route"] = route
            return
