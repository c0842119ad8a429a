"""Access over HTTP."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import ExitStack
from http import HTTPStatus

from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.middleware.cors import CORSMiddleware
from starlette.responses import Response
from starlette.types import ASGIApp, Receive, Scope, Send

from service.http.responses import problem_response
from service.security.access import Access, needed_over_http
from service.security.key_file import Key
from service.telemetry.observer import Observer
from visloc.errors import VislocError


def add_access(app: Starlette, access: Access, observer: Observer, *, page: bool = False) -> None:
    """Put access control before the routes, and CORS before it if some pages may call.

    Call this before the outermost middleware is added, which gives requests their ids.

    Args:
        app: what is protected.
        access: the rules.
        observer: is told of refusals.
        page: whether the files of our own page are served, to everyone.
    """
    app.add_middleware(AccessControl, access=access, observer=observer, page=page)
    if access.origins:
        app.add_middleware(
            CORSMiddleware,
            allow_origins=sorted(access.origins),
            allow_methods=["GET", "POST", "PUT", "DELETE"],
            allow_headers=[
                *("Authorization", "X-API-Key", "X-Request-ID", "X-Request-Timeout"),
                "traceparent",
            ],
            expose_headers=["Location", "Retry-After", "X-Request-ID"],
        )


class AccessControl:
    """Lets a request through or refuses it, before any of its body is read."""

    def __init__(self, app: ASGIApp, access: Access, observer: Observer, *, page: bool) -> None:
        self._app = app
        self._access = access
        self._observer = observer
        self._page = page

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        key = None
        with ExitStack() as stack:
            try:
                host, origins = headers.get("host", ""), headers.getlist("origin")
                self._access.check_page(scope["scheme"], host, origins)
                tokens = tokens_of(headers.getlist("authorization"), headers.getlist("x-api-key"))
                needed = needed_over_http(scope["method"], scope["path"], page=self._page)
                key = self._access.key_of(tokens, needed)
                stack.enter_context(self._access.place(key))
            except VislocError as error:
                self._observer.error(error)
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


def tokens_of(authorizations: Iterable[str], api_keys: Iterable[str]) -> set[str]:
    """Return what was sent as API keys. Authorizations of other kinds are for a proxy."""
    tokens = set(api_keys)
    for authorization in authorizations:
        kind, _, token = authorization.partition(" ")
        if kind.lower() == "bearer":
            tokens.add(token.strip())
    return tokens
