"""Versions of maps over gRPC: publish, activate and delete versions of maps."""

from __future__ import annotations

from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import aclosing

from service.api.deadlines import request_id
from service.api.maps import map_info
from service.engine.engine import Engine
from service.grpc.envelope import Context, Envelope, message_of
from service.telemetry.observer import Observer
from visloc.errors import VislocError, refuse
from visloc_api.v1 import localization_pb2 as pb2
from visloc_api.v1 import localization_pb2_grpc as pb2_grpc


class MapsServicer(pb2_grpc.MapsServicer):
    """``visloc.v1.Maps`` over the engine."""

    def __init__(self, engine: Engine, observer: Observer) -> None:
        self._engine, self._envelope = engine, Envelope(observer)

    async def GetVersion(  # noqa: N802  the name in the proto
        self, request: pb2.VersionRef, context: Context
    ) -> pb2.MapInfo:
        """Describe one published version, current or not."""
        async with self._envelope("GetVersion", request_id(None), context):
            served = await self._engine.map(f"{request.map}@{request.version}")
            return message_of(map_info(served), pb2.MapInfo())

    async def PutVersion(  # noqa: N802
        self, request_iterator: AsyncIterator[pb2.PutVersionRequest], context: Context
    ) -> pb2.MapInfo:
        """Publish a version from its packed file."""
        async with self._envelope("PutVersion", request_id(None), context):
            first = await anext(request_iterator, None)
            kind = None if first is None else first.WhichOneof("message")
            if first is None or kind != "start":
                raise _wrong_message("start", kind)
            async with aclosing(_chunks(request_iterator)) as chunks:
                served = await self._engine.upload(first.start.map, first.start.version, chunks)
            return message_of(map_info(served), pb2.MapInfo())

    async def DeleteVersion(  # noqa: N802
        self, request: pb2.VersionRef, context: Context
    ) -> pb2.DeleteVersionResponse:
        """Delete a version that is not current."""
        async with self._envelope("DeleteVersion", request_id(None), context):
            await self._engine.delete(request.map, request.version)
            return pb2.DeleteVersionResponse()

    async def SetCurrent(  # noqa: N802
        self, request: pb2.VersionRef, context: Context
    ) -> pb2.MapInfo:
        """Make a version current."""
        async with self._envelope("SetCurrent", request_id(None), context):
            served = await self._engine.set_current(request.map, request.version)
            return message_of(map_info(served), pb2.MapInfo())


async def _chunks(messages: AsyncIterator[pb2.PutVersionRequest]) -> AsyncGenerator[bytes]:
    async for message in messages:
        kind = message.WhichOneof("message")
        if kind != "chunk":
            raise _wrong_message("chunk", kind)
        yield message.chunk


def _wrong_message(expected: str, got: str | None) -> VislocError:
    return refuse("upload.message", field="message", expected=expected, got=got or "nothing")
