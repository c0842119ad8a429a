"""Errors as both transports report them: the table of statuses."""

from __future__ import annotations

from collections.abc import Mapping
from http import HTTPStatus

import grpc

from visloc.errors import (
    Conflict,
    DatasetError,
    Forbidden,
    InvalidInput,
    MapCorrupt,
    NotFound,
    Overloaded,
    StorageFull,
    TimedOut,
    TooLarge,
    Unauthenticated,
    Unavailable,
    VislocError,
    WeightsError,
    refuse,
)

STATUSES: Mapping[type[VislocError], tuple[HTTPStatus, grpc.StatusCode]] = {
    VislocError: (HTTPStatus.INTERNAL_SERVER_ERROR, grpc.StatusCode.INTERNAL),
    InvalidInput: (HTTPStatus.UNPROCESSABLE_ENTITY, grpc.StatusCode.INVALID_ARGUMENT),
    TooLarge: (HTTPStatus.REQUEST_ENTITY_TOO_LARGE, grpc.StatusCode.RESOURCE_EXHAUSTED),
    DatasetError: (HTTPStatus.UNPROCESSABLE_ENTITY, grpc.StatusCode.INVALID_ARGUMENT),
    WeightsError: (HTTPStatus.CONFLICT, grpc.StatusCode.FAILED_PRECONDITION),
    NotFound: (HTTPStatus.NOT_FOUND, grpc.StatusCode.NOT_FOUND),
    Conflict: (HTTPStatus.CONFLICT, grpc.StatusCode.FAILED_PRECONDITION),
    MapCorrupt: (HTTPStatus.INTERNAL_SERVER_ERROR, grpc.StatusCode.DATA_LOSS),
    Unavailable: (HTTPStatus.SERVICE_UNAVAILABLE, grpc.StatusCode.UNAVAILABLE),
    Overloaded: (HTTPStatus.TOO_MANY_REQUESTS, grpc.StatusCode.RESOURCE_EXHAUSTED),
    TimedOut: (HTTPStatus.GATEWAY_TIMEOUT, grpc.StatusCode.DEADLINE_EXCEEDED),
    StorageFull: (HTTPStatus.INSUFFICIENT_STORAGE, grpc.StatusCode.RESOURCE_EXHAUSTED),
    Unauthenticated: (HTTPStatus.UNAUTHORIZED, grpc.StatusCode.UNAUTHENTICATED),
    Forbidden: (HTTPStatus.FORBIDDEN, grpc.StatusCode.PERMISSION_DENIED),
}

# Codes with another status than their class. Balancers and gRPC clients retry what is Unavailable
# on the next server: a photo that killed one process here would kill another one there.
_STATUSES_OF_CODES = {
    "server.worker_died": (HTTPStatus.INTERNAL_SERVER_ERROR, grpc.StatusCode.INTERNAL)
}

RETRY_AFTER_S = 1


def statuses_of(error: VislocError) -> tuple[HTTPStatus, grpc.StatusCode]:
    """Return the HTTP and the gRPC status of an error, by the nearest class in the table."""
    if error.code in _STATUSES_OF_CODES:
        return _STATUSES_OF_CODES[error.code]
    return next(STATUSES[kind] for kind in type(error).__mro__ if kind in STATUSES)


def internal_error() -> VislocError:
    """Return the error for a bug of the server."""
    return refuse("server.internal")


def stopping_error() -> VislocError:
    """Return the error for a request that the end of the server interrupts."""
    return refuse("server.stopping")


def too_slow(grace_s: float, got: str) -> VislocError:
    """Return the error of a request whose body or next message does not arrive in time."""
    return refuse(
        "request.too_slow",
        expected=f"all within {grace_s:g} s, and a second more for every 100 kB",
        got=got,
    )
