"""What both doors share: one table of statuses, and request ids."""

from __future__ import annotations

import re
import uuid
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

# Of which the status is not their kind's. Balancers and gRPC clients send what is Unavailable once
# more, to the next server: a photo that ended one process there would end another one here.
_STATUSES_OF_CODES = {
    "server.worker_died": (HTTPStatus.INTERNAL_SERVER_ERROR, grpc.StatusCode.INTERNAL)
}

RETRY_AFTER_S = 1

_REQUEST_ID = re.compile(r"[\x21-\x7e]{1,128}")


def statuses_of(error: VislocError) -> tuple[HTTPStatus, grpc.StatusCode]:
    """Return the HTTP and the gRPC status of an error, by the nearest class in the table."""
    if error.code in _STATUSES_OF_CODES:
        return _STATUSES_OF_CODES[error.code]
    return next(STATUSES[kind] for kind in type(error).__mro__ if kind in STATUSES)


def internal_error() -> VislocError:
    """Return what a caller is told when something broke that should not have."""
    return refuse("server.internal")


def stopping_error() -> VislocError:
    """Return what a caller is told whose request the end of the server cuts off."""
    return refuse("server.stopping")


def request_id(given: str | None) -> str:
    """Return the caller's id when it is short and visible ASCII, else a new one."""
    return given if given and _REQUEST_ID.fullmatch(given) else uuid.uuid4().hex
