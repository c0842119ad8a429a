"""Requests over gRPC."""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncGenerator, AsyncIterable, Callable, Iterator
from contextlib import aclosing
from functools import partial
from typing import Any, assert_never

import grpc
from google.protobuf.message import DecodeError, Message

from clients import errors
from clients.transport.connection import Connection
from clients.transport.grpc_errors import Metadata, grpc_failure
from clients.transport.grpc_streams import stream_answers
from clients.transport.messages import (
    list_maps_message,
    localize_message,
    plain,
    version_message,
)
from clients.transport.retry import GRPC_OPTIONS, map_header
from clients.transport.uploads import OnProgress, Upload, pieces
from clients.wire.requests import (
    CheckReady,
    DeleteVersion,
    GetImages,
    GetMap,
    GetServer,
    GetVersion,
    JsonObject,
    ListMaps,
    Localize,
    Request,
    StartSequence,
    UseVersion,
)
from visloc.errors import VislocError, refuse
from visloc_api.v1 import localization_pb2 as wire
from visloc_api.words.rigs import LocalizeRigRequest
from visloc_api.words.sequences import Instant
from visloc_api.words.wire import VERSION_KEY

_SERVICE = f"/{wire.DESCRIPTOR.services_by_name['Localization'].full_name}"
_MAPS = f"/{wire.DESCRIPTOR.services_by_name['Maps'].full_name}"
_PUT_VERSION = f"{_MAPS}/PutVersion"
_SEQUENCE = f"{_SERVICE}/LocalizeSequence"
# HealthCheckResponse with status SERVING; two bytes are not worth another dependency.
_SERVING = b"\x08\x01"
# The process that first used gRPC.
_process: int | None = None


class GrpcTransport:
    """Sends requests to one server, from the event loop in which it is first used."""

    def __init__(self, connection: Connection) -> None:
        self._server, self._timeout_s = connection.server, connection.timeout_s
        self._connection = connection
        self._channel: grpc.aio.Channel | None = None

    async def send(self, request: Request) -> JsonObject:
        """Return the answer as plain JSON, the same as over HTTP."""
        path, message, decode = _encode(request)
        make_call = self._opened().unary_unary(path, None, None)
        metadata = _metadata(self._connection, request)
        call = make_call(message, timeout=self._timeout_s, metadata=metadata)
        try:
            answer = await call
            received = await call.initial_metadata()
        except grpc.aio.AioRpcError as error:
            raise grpc_failure(self._server, self._timeout_s, error) from error
        return _decoded(self._server, decode, answer, received)

    async def stream(
        self, start: StartSequence, instants: AsyncIterable[Instant]
    ) -> AsyncGenerator[JsonObject, None]:
        """Send instants as the server takes them, and give each answer as it comes."""
        make_call: Any = self._opened().stream_stream(_SEQUENCE, None, None)
        call = partial(make_call, metadata=_metadata(self._connection, start))
        answers = stream_answers(call, self._server, self._timeout_s, start, instants)
        async with aclosing(answers):
            async for answer in answers:
                yield answer

    async def upload(self, upload: Upload, on_progress: OnProgress) -> JsonObject:
        """Send a packed map, and return its description; ``on_progress`` is called in a thread."""
        # Not grpc.aio: it loses the answer to a call that is still being written.
        channel = _open_channel(grpc, self._connection)
        try:
            return await asyncio.to_thread(self._upload, channel, upload, on_progress)
        finally:
            channel.close()  # cancels the call when this coroutine is cancelled

    def _upload(self, channel: grpc.Channel, upload: Upload, on_progress: OnProgress) -> JsonObject:
        failure: VislocError | OSError | None = None

        def messages() -> Iterator[bytes]:
            nonlocal failure
            start = version_message(upload.map_id, upload.version)
            yield wire.PutVersionRequest(start=start).SerializeToString()
            try:
                for piece in pieces(upload, on_progress):
                    yield wire.PutVersionRequest(chunk=piece).SerializeToString()
            except (VislocError, OSError) as error:
                # gRPC would only log it. The server takes nothing that ends early.
                failure = error

        call = channel.stream_unary(_PUT_VERSION, None, None)
        within_s = upload.done_within_s(self._timeout_s)
        metadata = _metadata(self._connection, upload)
        try:
            answer, context = call.with_call(messages(), timeout=within_s, metadata=metadata)
        except grpc.RpcError as error:
            raise failure or grpc_failure(self._server, within_s, error) from error
        return _decoded(self._server, _reads(wire.MapInfo), answer, context.initial_metadata())

    async def close(self) -> None:
        if self._channel is not None:
            await self._channel.close(None)

    def _opened(self) -> grpc.aio.Channel:
        if self._channel is None:  # not in the constructor: it binds to the running loop
            _refuse_after_fork()
            self._channel = _open_channel(grpc.aio, self._connection)
        return self._channel


_Decode = Callable[[bytes, Metadata], JsonObject]


def _open_channel(library: Any, connection: Connection) -> Any:
    """Open a channel of ``grpc`` or ``grpc.aio``."""
    target = connection.server.partition("://")[2].rstrip("/")
    if not connection.is_encrypted:
        return library.insecure_channel(target, GRPC_OPTIONS)
    authorities = connection.authorities
    certificates = None if authorities is None else authorities.encode()
    credentials = grpc.ssl_channel_credentials(certificates)
    return library.secure_channel(target, credentials, GRPC_OPTIONS)


def _refuse_after_fork() -> None:
    """Refuse to wait for an answer that never comes: grpc.aio does not survive a fork."""
    global _process
    if _process not in (None, os.getpid()):
        raise RuntimeError(
            "gRPC cannot be used here: this process was forked after its parent used it; start "
            "processes by 'spawn', or use HTTP"
        )
    _process = os.getpid()


def _metadata(
    connection: Connection, request: Request | StartSequence | Upload
) -> tuple[tuple[str, str], ...]:
    key = connection.api_key
    authorization = {} if key is None else {"authorization": f"Bearer {key}"}
    return tuple((authorization | map_header(request)).items())


def _encode(request: Request) -> tuple[str, bytes, _Decode]:
    """Return the method, the message, and the function that reads the answer."""
    match request:
        case Localize():
            message = localize_message(request).SerializeToString()
            if isinstance(request.words, LocalizeRigRequest):
                return f"{_SERVICE}/LocalizeRig", message, _reads(wire.InstantAnswer)
            return f"{_SERVICE}/Localize", message, _reads(wire.LocalizeResponse)
        case ListMaps():
            message = list_maps_message(request).SerializeToString()
            return f"{_SERVICE}/ListMaps", message, _reads(wire.ListMapsResponse)
        case GetMap():
            message = wire.GetMapRequest(map=request.map).SerializeToString()
            return f"{_SERVICE}/GetMap", message, _reads(wire.MapInfo)
        case GetImages():
            message = "photos of maps are described over HTTP only"
            raise refuse("server.url", message, expected="http://host:port")
        case GetVersion():
            return f"{_MAPS}/GetVersion", _version_message(request), _reads(wire.MapInfo)
        case UseVersion():
            return f"{_MAPS}/SetCurrent", _version_message(request), _reads(wire.MapInfo)
        case DeleteVersion():
            return (
                f"{_MAPS}/DeleteVersion",
                _version_message(request),
                _reads(wire.DeleteVersionResponse),
            )
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


def _reads(kind: type[Message]) -> _Decode:
    return lambda answer, _: plain(kind.FromString(answer))


def _read_server(_: bytes, metadata: Metadata) -> JsonObject:
    return {"version": dict(metadata).get(VERSION_KEY)}


def _read_ready(answer: bytes, _: Metadata) -> JsonObject:
    return {"ready": answer == _SERVING}
