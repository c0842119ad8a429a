"""Failures of gRPC as exceptions of ``visloc.errors``."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import cast

import grpc
from google.protobuf.message import DecodeError
from google.rpc import error_details_pb2, status_pb2

from clients import errors
from visloc.errors import VislocError
from visloc_api.words.wire import ERROR_DOMAIN

Metadata = Iterable[tuple[str, str | bytes]]

_STATUS_KEY = "grpc-status-details-bin"

_FALLBACKS: Mapping[grpc.StatusCode, errors.Fallback] = {
    grpc.StatusCode.INVALID_ARGUMENT: errors.INVALID,
    grpc.StatusCode.OUT_OF_RANGE: errors.INVALID,
    grpc.StatusCode.UNAUTHENTICATED: errors.UNAUTHENTICATED,
    grpc.StatusCode.PERMISSION_DENIED: errors.FORBIDDEN,
    grpc.StatusCode.NOT_FOUND: errors.NOT_FOUND,
    grpc.StatusCode.ALREADY_EXISTS: errors.CONFLICT,
    grpc.StatusCode.FAILED_PRECONDITION: errors.CONFLICT,
    grpc.StatusCode.ABORTED: errors.CONFLICT,
    # Without our details it comes from gRPC itself: too many calls, or a message that is too large.
    grpc.StatusCode.RESOURCE_EXHAUSTED: errors.OVERLOADED,
}


def grpc_failure(server: str, timeout_s: float, error: grpc.RpcError) -> VislocError:
    """Make the exception for a failed call."""
    code, details = error.code(), error.details() or ""
    info = _error_info(error)
    if info is not None:
        parts = {**info.metadata, "code": info.reason}
        return errors.received(parts, _FALLBACKS.get(code, errors.INTERNAL), details)
    match code:
        case grpc.StatusCode.UNAVAILABLE:
            return errors.unreachable(server, details)
        case grpc.StatusCode.DEADLINE_EXCEEDED:
            return errors.timed_out(server, timeout_s)
        case grpc.StatusCode.UNIMPLEMENTED:
            return errors.not_understood(server, details)
    message = f"the server answered {code.name}: {details}"
    if code is grpc.StatusCode.RESOURCE_EXHAUSTED and "larger than max" in details:
        return errors.received({}, errors.TOO_LARGE, message)
    return errors.received({}, _FALLBACKS.get(code, errors.INTERNAL), message)


def _error_info(error: grpc.RpcError) -> error_details_pb2.ErrorInfo | None:
    # Not grpcio-status: it has no function for the errors of both grpc and grpc.aio.
    metadata = cast("Metadata", error.trailing_metadata() or ())
    for key, value in metadata:
        if key == _STATUS_KEY and isinstance(value, bytes):
            try:
                status = status_pb2.Status.FromString(value)
            except DecodeError:
                return None
            for detail in status.details:
                info = error_details_pb2.ErrorInfo()
                if detail.Unpack(info) and info.domain == ERROR_DOMAIN:
                    return info
    return None
