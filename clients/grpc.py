"""Requests over gRPC, synchronous and asynchronous."""

from __future__ import annotations

from collections.abc import AsyncGenerator, AsyncIterable, Callable, Iterable, Iterator
from contextlib import aclosing
from typing import assert_never

import grpc
from google.protobuf.message import DecodeError

from clients import errors
from clients.grpc_errors import Metadata, grpc_failure
from clients.grpc_streams import stream_answers, stream_answers_async
from clients.messages import localize_message, plain, rig_message
from clients.requests import CheckReady, GetMap, GetServer, JsonObject, ListMaps, Localize
from clients.rig_requests import AnyRequest, LocalizeRig, SentInstant, SequenceStart
from visloc_api.v1 import localization_pb2 as wire

_SERVICE = f"/{wire.DESCRIPTOR.services_by_name['Localization'].full_name}"
_SEQUENCE = f"{_SERVICE}/LocalizeSequence"
# Sent by the service with every answer; the protocol has no other place for it.
_VERSION_KEY = "visloc-version"
# HealthCheckResponse with status SERVING. Two bytes are not worth another dependency.
_SERVING = b"\x08\x01"


class GrpcTransport:
    """Sends requests and waits for the answers; safe to share between threads."""

    def __init__(self, server: str, timeout_s: float) -> None:
        self._server, self._timeout_s = server, timeout_s
        self._channel = grpc.insecure_channel(_target(server))

    def send(self, request: AnyRequest) -> JsonObject:
        """Return the answer as plain JSON, the same as over HTTP.

        Raises:
            VislocError: what the server refused, or ``server.*``.
        """
        path, message, decode = _encode(request)
        call = self._channel.unary_unary(path, None, None)
        try:
            answer, context = call.with_call(message, timeout=self._timeout_s)
        except grpc.RpcError as error:
            raise grpc_failure(self._server, self._timeout_s, error) from error
        return _decoded(self._server, decode, answer, context.initial_metadata())

    def stream(self, start: SequenceStart, instants: Iterable[SentInstant]) -> Iterator[JsonObject]:
        """Send instants as the server takes them, and give each answer as it comes.

        Raises:
            VislocError: as ``send``.
        """
        call = self._channel.stream_stream(_SEQUENCE, None, None)
        yield from stream_answers(call, self._server, self._timeout_s, start, instants)

    def close(self) -> None:
        """Close the connection."""
        self._channel.close()


class AsyncGrpcTransport:
    """``GrpcTransport`` for the event loop in which it is first used."""

    def __init__(self, server: str, timeout_s: float) -> None:
        self._server, self._timeout_s = server, timeout_s
        self._channel: grpc.aio.Channel | None = None

    async def send(self, request: AnyRequest) -> JsonObject:
        """As ``GrpcTransport.send``."""
        path, message, decode = _encode(request)
        call = self._opened().unary_unary(path, None, None)(message, timeout=self._timeout_s)
        try:
            answer = await call
            metadata = await call.initial_metadata()
        except grpc.aio.AioRpcError as error:
            raise grpc_failure(self._server, self._timeout_s, error) from error
        return _decoded(self._server, decode, answer, metadata)

    async def stream(
        self, start: SequenceStart, instants: AsyncIterable[SentInstant]
    ) -> AsyncGenerator[JsonObject, None]:
        """As ``GrpcTransport.stream``."""
        call = self._opened().stream_stream(_SEQUENCE, None, None)
        answers = stream_answers_async(call, self._server, self._timeout_s, start, instants)
        async with aclosing(answers):
            async for answer in answers:
                yield answer

    async def close(self) -> None:
        """Close the connection."""
        if self._channel is not None:
            await self._channel.close(None)

    def _opened(self) -> grpc.aio.Channel:
        if self._channel is None:  # not in the constructor: it binds to the running loop
            self._channel = grpc.aio.insecure_channel(_target(self._server))
        return self._channel


_Decode = Callable[[bytes, Metadata], JsonObject]


def _target(server: str) -> str:
    return server.removeprefix("grpc://").rstrip("/")


def _encode(request: AnyRequest) -> tuple[str, bytes, _Decode]:
    """Return method, message, and the function that reads the answer."""
    match request:
        case Localize():
            message = localize_message(request).SerializeToString()
            return f"{_SERVICE}/Localize", message, _read_localize
        case LocalizeRig():
            message = rig_message(request).SerializeToString()
            return f"{_SERVICE}/LocalizeRig", message, _read_instant
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


def _decoded(server: str, decode: _Decode, answer: bytes, metadata: Metadata) -> JsonObject:
    try:
        return decode(answer, metadata)
    except DecodeError as error:
        raise errors.not_understood(server, str(error)) from error


def _read_localize(answer: bytes, _: Metadata) -> JsonObject:
    return plain(wire.LocalizeResponse.FromString(answer))


def _read_instant(answer: bytes, _: Metadata) -> JsonObject:
    return plain(wire.InstantAnswer.FromString(answer))


def _read_maps(answer: bytes, _: Metadata) -> JsonObject:
    return plain(wire.ListMapsResponse.FromString(answer))


def _read_map(answer: bytes, _: Metadata) -> JsonObject:
    return plain(wire.MapInfo.FromString(answer))


def _read_server(_: bytes, metadata: Metadata) -> JsonObject:
    return {"version": dict(metadata).get(_VERSION_KEY)}


def _read_ready(answer: bytes, _: Metadata) -> JsonObject:
    return {"ready": answer == _SERVING}
