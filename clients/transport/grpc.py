"""Requests over gRPC, synchronous and asynchronous."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, AsyncIterable, Callable, Iterable, Iterator
from contextlib import aclosing
from functools import partial
from typing import Any, assert_never

import grpc
from google.protobuf.message import DecodeError

from clients import errors
from clients.transport.connection import Connection
from clients.transport.grpc_errors import Metadata, grpc_failure
from clients.transport.grpc_streams import stream_answers, stream_answers_async
from clients.transport.grpc_uploads import UploadFeed
from clients.transport.messages import (
    list_maps_message,
    localize_message,
    plain,
    rig_message,
    version_message,
)
from clients.transport.retry import GRPC_OPTIONS, map_header
from clients.transport.uploads import OnProgress, Upload
from clients.wire.requests import (
    CheckReady,
    DeleteVersion,
    GetMap,
    GetServer,
    GetVersion,
    JsonObject,
    ListMaps,
    Localize,
    UseVersion,
)
from clients.wire.rig_requests import AnyRequest, LocalizeRig, SentInstant, SequenceStart
from visloc_api.v1 import localization_pb2 as wire
from visloc_api.words.wire import VERSION_KEY

_SERVICE = f"/{wire.DESCRIPTOR.services_by_name['Localization'].full_name}"
_MAPS = f"/{wire.DESCRIPTOR.services_by_name['Maps'].full_name}"
_PUT_VERSION = f"{_MAPS}/PutVersion"
_SEQUENCE = f"{_SERVICE}/LocalizeSequence"
# HealthCheckResponse with status SERVING. Two bytes are not worth another dependency.
_SERVING = b"\x08\x01"


class GrpcTransport:
    """Sends requests and waits for the answers; safe to share between threads."""

    def __init__(self, connection: Connection) -> None:
        self._server, self._timeout_s = connection.server, connection.timeout_s
        self._connection = connection
        target, credentials = _target(connection), _credentials(connection)
        if credentials is None:
            self._channel = grpc.insecure_channel(target, GRPC_OPTIONS)
        else:
            self._channel = grpc.secure_channel(target, credentials, GRPC_OPTIONS)

    def send(self, request: AnyRequest) -> JsonObject:
        """Return the answer as plain JSON, the same as over HTTP.

        Raises:
            VislocError: what the server refused, or ``server.*``.
        """
        path, message, decode = _encode(request)
        call = self._channel.unary_unary(path, None, None)
        try:
            answer, context = call.with_call(
                message, timeout=self._timeout_s, metadata=_metadata(self._connection, request)
            )
        except grpc.RpcError as error:
            raise grpc_failure(self._server, self._timeout_s, error) from error
        return _decoded(self._server, decode, answer, context.initial_metadata())

    def stream(self, start: SequenceStart, instants: Iterable[SentInstant]) -> Iterator[JsonObject]:
        """Send instants as the server takes them, and give each answer as it comes.

        Raises:
            VislocError: as ``send``.
        """
        metadata = _metadata(self._connection, start)
        call = partial(self._channel.stream_stream(_SEQUENCE, None, None), metadata=metadata)
        yield from stream_answers(call, self._server, self._timeout_s, start, instants)

    def upload(self, upload: Upload, on_progress: OnProgress) -> JsonObject:
        """Send a packed map, and return what it is.

        Raises:
            VislocError: as ``send``, and what the file raises.
        """
        feed = UploadFeed(upload, on_progress)
        call = self._channel.stream_unary(_PUT_VERSION, None, None)
        within_s = upload.done_within_s(self._timeout_s)
        metadata = _metadata(self._connection, upload)
        try:
            answer, context = call.with_call(feed.messages(), timeout=within_s, metadata=metadata)
        except grpc.RpcError as error:
            raise feed.failure or grpc_failure(self._server, within_s, error) from error
        return _decoded(self._server, _read_map, answer, context.initial_metadata())

    def close(self) -> None:
        """Close the connection."""
        self._channel.close()


class AsyncGrpcTransport:
    """``GrpcTransport`` for the event loop in which it is first used."""

    def __init__(self, connection: Connection) -> None:
        self._server, self._timeout_s = connection.server, connection.timeout_s
        self._connection = connection
        self._channel: grpc.aio.Channel | None = None

    async def send(self, request: AnyRequest) -> JsonObject:
        """As ``GrpcTransport.send``."""
        path, message, decode = _encode(request)
        make_call = self._opened().unary_unary(path, None, None)
        metadata = _metadata(self._connection, request)
        call = make_call(message, timeout=self._timeout_s, metadata=metadata)
        try:
            answer = await call
            said = await call.initial_metadata()
        except grpc.aio.AioRpcError as error:
            raise grpc_failure(self._server, self._timeout_s, error) from error
        return _decoded(self._server, decode, answer, said)

    async def stream(
        self, start: SequenceStart, instants: AsyncIterable[SentInstant]
    ) -> AsyncGenerator[JsonObject, None]:
        """As ``GrpcTransport.stream``."""
        make_call: Any = self._opened().stream_stream(_SEQUENCE, None, None)
        call = partial(make_call, metadata=_metadata(self._connection, start))
        answers = stream_answers_async(call, self._server, self._timeout_s, start, instants)
        async with aclosing(answers):
            async for answer in answers:
                yield answer

    async def upload(self, upload: Upload, on_progress: OnProgress) -> JsonObject:
        """As ``GrpcTransport.upload``; ``on_progress`` is called in another thread."""
        # Not grpc.aio, which loses what the server says to a call that is still being written.
        sending = GrpcTransport(self._connection)
        try:
            return await asyncio.to_thread(sending.upload, upload, on_progress)
        finally:
            sending.close()  # when this is cancelled, the call is

    async def close(self) -> None:
        """Close the connection."""
        if self._channel is not None:
            await self._channel.close(None)

    def _opened(self) -> grpc.aio.Channel:
        if self._channel is None:  # not in the constructor: it binds to the running loop
            target, credentials = _target(self._connection), _credentials(self._connection)
            if credentials is None:
                self._channel = grpc.aio.insecure_channel(target, GRPC_OPTIONS)
            else:
                self._channel = grpc.aio.secure_channel(target, credentials, GRPC_OPTIONS)
        return self._channel


_Decode = Callable[[bytes, Metadata], JsonObject]


def _target(connection: Connection) -> str:
    return connection.server.partition("://")[2].rstrip("/")


def _credentials(connection: Connection) -> grpc.ChannelCredentials | None:
    if not connection.is_encrypted:
        return None
    authorities = connection.authorities
    return grpc.ssl_channel_credentials(None if authorities is None else authorities.encode())


def _metadata(
    connection: Connection, request: AnyRequest | SequenceStart | Upload
) -> tuple[tuple[str, str], ...]:
    key = connection.api_key
    of_key = {} if key is None else {"authorization": f"Bearer {key}"}
    return tuple((of_key | map_header(request)).items())


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
            message = list_maps_message(request).SerializeToString()
            return f"{_SERVICE}/ListMaps", message, _read_maps
        case GetMap():
            message = wire.GetMapRequest(map=request.map).SerializeToString()
            return f"{_SERVICE}/GetMap", message, _read_map
        case GetVersion():
            return f"{_MAPS}/GetVersion", _version_message(request), _read_map
        case UseVersion():
            return f"{_MAPS}/SetCurrent", _version_message(request), _read_map
        case DeleteVersion():
            return f"{_MAPS}/DeleteVersion", _version_message(request), _read_nothing
        case GetServer():
            return f"{_SERVICE}/ListMaps", b"", _read_server
        case CheckReady():
            return "/grpc.health.v1.Health/Check", b"", _read_ready
    assert_never(request)


def _version_message(request: GetVersion | UseVersion | DeleteVersion) -> bytes:
    return version_message(request.map_id, request.version).SerializeToString()


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


def _read_nothing(answer: bytes, _: Metadata) -> JsonObject:
    return plain(wire.DeleteVersionResponse.FromString(answer))


def _read_server(_: bytes, metadata: Metadata) -> JsonObject:
    return {"version": dict(metadata).get(VERSION_KEY)}


def _read_ready(answer: bytes, _: Metadata) -> JsonObject:
    return {"ready": answer == _SERVING}
