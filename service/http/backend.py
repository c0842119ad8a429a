"""The parts of the service that the routes use; kept in the state of the app."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from starlette.requests import Request

from service.api.deadlines import TimeLimit, time_limit_of
from service.engine.engine import Engine
from service.http.acceptor import OpenConnections
from service.http.slow_clients import Arrivals
from service.security.access import Access
from service.settings import ServiceSettings
from service.telemetry.metrics import ServiceState
from service.telemetry.observer import Observer
from visloc_api.words.wire import TIMEOUT_HEADER


@dataclass(frozen=True, slots=True)
class Backend:
    """The parts of the service behind the HTTP API.

    Attributes:
        arrivals: the request bodies that are arriving.
        connections: the open HTTP connections.
        state: returns the current state of the service, for ``/metrics``.
    """

    engine: Engine
    settings: ServiceSettings
    observer: Observer
    access: Access
    arrivals: Arrivals
    connections: OpenConnections
    state: Callable[[], ServiceState]


def backend_of(request: Request) -> Backend:
    """Return the backend that ``create_app`` put into the state of the app."""
    backend: Backend = request.app.state.backend
    return backend


def limit_of(request: Request) -> TimeLimit:
    """Return the time that the request may take.

    Raises:
        InvalidInput: ``request.timeout``.
    """
    limit_s = backend_of(request).settings.request_timeout_s
    return time_limit_of(request.headers.get(TIMEOUT_HEADER), limit_s)
