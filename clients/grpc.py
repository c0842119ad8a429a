"""Requests over gRPC, synchronous and asynchronous."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, assert_never, cast

import grpc
from google.protobuf.json_format import MessageToDict
from google.protobuf.message import DecodeError, Message
from google.rpc import error_details_pb2, status_pb2
from numpy.typing import NDArray

from clients import errors
from clients.features import Features
from clients.requests import (
    CheckReady,
    GetMap,
    GetServer,
    JsonObject,
    ListMaps,
    Localize,
    Request,
)
from visloc.errors import VislocError
from visloc_api.v1 import localization_pb2 as wire

_SERVICE = f"/{wire.DESCRIPTOR.services_by_name['Localization'].full_name}"
# Sent by the service with every answer; the protocol has no other place for it.
_VERSION_KEY = "visloc-version"
_STATUS_KEY = "grpc-status-details-bin"
# HealthCheckResponse with status SERVING. Two bytes are not worth another dependency.
_SERVING = b"\x08\x01"

_FALLBACKS: Mapping[grpc.StatusCode, errors.Fallback] = {
    grpc.StatusCode.INVALID_ARGUMENT: errors.INVALID,
    grpc.StatusCode.OUT_OF_RANGE: errors.INVALID,
    grpc.StatusCode.NOT_FOUND: errors.NOT_FOUND,
    grpc.StatusCode.ALREADY_EXISTS: errors.CONFLICT,
    grpc.StatusCode.FAILED_PRECONDITION: errors.CONFLICT,
    grpc.StatusCode.ABORTED: errors.CONFLICT,
    # Without our details it comes from gRPC itself: too many calls at once, or as below.
    grpc.StatusCode.RESOURCE_EXHAUSTED: errors.OVERLOADED,
}


class GrpcTransport:
    """Sends requests and waits for the answers; safe to share between threads."""

    def __init__(self, server: str, timeout_s: float) -> None:
        self._server, self._timeout_s = server, timeout_s
        self._channel = grpc.insecure_channel(_target(server))

    def send(self, request: Request) -> JsonObject:
        """Return the answer as plain JSON, the same as over HTTP.

        Raises:
            VislocError: what the server refused, or ``server.*``.
        """
        path, message, decode = _encode(request)
        call = self._channel.unary_unary(path, None, None)
        try:
            answer, context = call.with_call(message, timeout=self._timeout_s)
        except grpc.RpcError as error:
            raise _failure(self._server, self._timeout_s, error) from error
        return _decoded(self._server, decode, answer, context.initial_metadata())

    def close(self) -> None:
        """Close the connection."""
        self._channel.close()


class AsyncGrpcTransport:
    """``GrpcTransport`` for the event loop in which it is first used."""

    def __init__(self, server: str, timeout_s: float) -> None:
        self._server, self._timeout_s = server, timeout_s
        self._channel: grpc.aio.Channel | None = None

    async def send(self, request: Request) -> JsonObject:
        """As ``GrpcTransport.send``."""
        if self._channel is None:  # not in the constructor: it binds to the running loop
            self._channel = grpc.aio.insecure_channel(_target(self._server))
        path, message, decode = _encode(request)
        call = self._channel.unary_unary(path, None, None)(message, timeout=self._timeout_s)
        try:
            answer = await call
            metadata = await call.initial_metadata()
        except grpc.aio.AioRpcError as error:
            raise _failure(self._server, self._timeout_s, error) from error
        return _decoded(self._server, decode, answer, metadata)

    async def close(self) -> None:
        """Close the connection."""
        if self._channel is not None:
            await self._channel.close(None)


_Metadata = Iterable[tuple[str, str | bytes]]
_Decode = Callable[[bytes, _Metadata], JsonObject]


def _target(server: str) -> str:
    return server.removeprefix("grpc://").rstrip("/")


def _encode(request: Request) -> tuple[str, bytes, _Decode]:
    """Return method, message, and the function that reads the answer."""
    match request:
        case Localize():
            message = _localize_message(request).SerializeToString()
            return f"{_SERVICE}/Localize", message, _read_localize
        case ListMaps():
            return f"{_SERVICE}/ListMaps", b"", _read_maps
        case GetMap():
            message = wire.GetMapRequest(map=request.map).SerializeToString()
            return f"{_SERVICE}/GetMap", message, _read_map
        case GetServer():
            return f"{_SERVICE}/ListMaps", b"", _read_server
        case CheckReady():
            return "/grpc.health.v1.Health/Check", b"", _read_ready
    assert_never(request)


def _localize_message(request: Localize) -> wire.LocalizeRequest:
    message = wire.LocalizeRequest(map=request.map)
    if isinstance(request.query, Features):
        message.features.CopyFrom(_features_message(request.query))
    else:
        message.image = request.query
    if request.camera is not None:
        camera = request.camera
        message.camera.model = camera.model
        message.camera.width = camera.width
        message.camera.height = camera.height
        message.camera.params.extend(camera.params)
    for name, value in request.options.given().items():
        setattr(message.options, name, value)
    if request.request_id is not None:
        message.request_id = request.request_id
    return message


def _features_message(features: Features) -> wire.Features:
    return wire.Features(
        kind=features.kind,
        keypoints=_array_message(features.keypoints),
        descriptors=_array_message(features.descriptors),
        global_descriptors={
            name: _array_message(row) for name, row in features.global_descriptors.items()
        },
    )


def _array_message(array: NDArray[Any]) -> wire.Array:
    return wire.Array(dtype=array.dtype.name, shape=array.shape, data=array.tobytes())


def _decoded(server: str, decode: _Decode, answer: bytes, metadata: _Metadata) -> JsonObject:
    try:
        return decode(answer, metadata)
    except DecodeError as error:
        raise errors.not_understood(server, str(error)) from error


def _read_localize(answer: bytes, _: _Metadata) -> JsonObject:
    return _plain(wire.LocalizeResponse.FromString(answer))


def _read_maps(answer: bytes, _: _Metadata) -> JsonObject:
    return {"maps": [_plain_map(info) for info in wire.ListMapsResponse.FromString(answer).maps]}


def _read_map(answer: bytes, _: _Metadata) -> JsonObject:
    return _plain_map(wire.MapInfo.FromString(answer))


def _read_server(_: bytes, metadata: _Metadata) -> JsonObject:
    return {"version": dict(metadata).get(_VERSION_KEY)}


def _read_ready(answer: bytes, _: _Metadata) -> JsonObject:
    return {"ready": answer == _SERVING}


def _plain(message: Message) -> dict[str, Any]:
    plain = MessageToDict(
        message, preserving_proto_field_name=True, always_print_fields_with_no_presence=True
    )
    # As JSON has it: every field in its place, null for what is absent.
    return {field.name: plain.get(field.name) for field in message.DESCRIPTOR.fields}


def _plain_map(info: wire.MapInfo) -> JsonObject:
    # protobuf writes 64-bit integers as strings.
    return _plain(info) | {"size_bytes": info.size_bytes}


def _failure(server: str, timeout_s: float, error: grpc.RpcError) -> VislocError:
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
    # Read here rather than with grpcio-status, which has no function for both kinds of error.
    metadata = cast("_Metadata", error.trailing_metadata() or ())
    for key, value in metadata:
        if key == _STATUS_KEY and isinstance(value, bytes):
            try:
                status = status_pb2.Status.FromString(value)
            except DecodeError:
                return None
            for detail in status.details:
                info = error_details_pb2.ErrorInfo()
                if detail.Unpack(info) and info.domain == "visloc":
                    return info
    return None
