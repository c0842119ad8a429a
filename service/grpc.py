"""The gRPC door."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import aclosing, asynccontextmanager
from time import perf_counter
from typing import Any, TypeVar

import grpc
from google.protobuf.any_pb2 import Any as AnyMessage
from google.protobuf.json_format import ParseDict
from google.protobuf.message import Message
from google.rpc.error_details_pb2 import ErrorInfo
from google.rpc.status_pb2 import Status
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection
from pydantic import BaseModel

import visloc
from service.engine import Engine
from service.grpc_requests import (
    instant_of,
    localize_job_of,
    rig_job_of,
    sequence_start_of,
)
from service.jobs import Instant, SequenceStart
from service.schemas import (
    BatchLimits,
    InstantAnswer,
    ListMapsResponse,
    LocalizeResponse,
    MapInfo,
)
from service.settings import ServiceSettings
from service.wire import internal_error, request_id, statuses_of
from visloc.errors import VislocError
from visloc_api.v1 import localization_pb2 as pb2
from visloc_api.v1 import localization_pb2_grpc as pb2_grpc

logger = logging.getLogger(__name__)

SERVICE_NAME = pb2.DESCRIPTOR.services_by_name["Localization"].full_name
ERROR_DOMAIN = "visloc"
# The server's version goes with every answer, as a header.
VERSION_KEY = "visloc-version"
# Details travel in a header, of which gRPC clients accept 8 kB by default.
_MAX_DETAIL = 1000

Context = grpc.aio.ServicerContext[Any, Any]
MessageT = TypeVar("MessageT", bound=Message)


class LocalizationServicer(pb2_grpc.LocalizationServicer):
    """``visloc.v1.Localization`` over the engine."""

    def __init__(self, engine: Engine, settings: ServiceSettings) -> None:
        self._engine = engine
        self._max_request_bytes = settings.max_request_bytes
        self._limits = BatchLimits(settings.max_rig_images, settings.max_instants)

    async def Localize(  # noqa: N802  the name in the proto
        self, request: pb2.LocalizeRequest, context: Context
    ) -> pb2.LocalizeResponse:
        """Estimate the camera pose of one photo, or of its features, in one map."""
        id_ = request_id(request.request_id)
        async with _envelope("Localize", id_, context):
            # Features take a moment to check: off the event loop with them.
            job = await asyncio.to_thread(localize_job_of, request, self._max_request_bytes)
            found = await self._engine.localize(job)
            answer = LocalizeResponse.from_localization(found, id_)
            return _message(answer, pb2.LocalizeResponse())

    async def LocalizeRig(  # noqa: N802
        self, request: pb2.LocalizeRigRequest, context: Context
    ) -> pb2.InstantAnswer:
        """Estimate one pose from the photos that the cameras of a rig took at one instant."""
        id_ = request_id(request.request_id)
        async with _envelope("LocalizeRig", id_, context):
            with self._engine.admit_batch():
                job = await asyncio.to_thread(rig_job_of, request, self._limits)
                found = await self._engine.localize_rig(job)
                answer = InstantAnswer.from_localization(found, id_)
                return _message(answer, pb2.InstantAnswer())

    # A coroutine that writes, not a generator: it ends, whatever becomes of the call, before the
    # place that it holds is given to another.
    async def LocalizeSequence(  # type: ignore[override]  # noqa: N802
        self, request_iterator: AsyncIterator[pb2.LocalizeSequenceRequest], context: Context
    ) -> None:
        """Answer the instants of a sequence in order, each as soon as its answer is final.

        No instant is read from the wire before the answers to those before it are taken.
        """
        first = await anext(request_iterator, None)
        id_ = request_id(first.start.request_id if first is not None else None)
        async with _envelope("LocalizeSequence", id_, context):
            with self._engine.admit_batch():
                start = await asyncio.to_thread(sequence_start_of, first)
                async with (
                    aclosing(self._instants(request_iterator, start)) as instants,
                    aclosing(self._engine.localize_sequence(start, instants)) as answers,
                ):
                    async for found in answers:
                        answer = InstantAnswer.from_localization(found, id_)
                        await context.write(_message(answer, pb2.InstantAnswer()))

    async def _instants(
        self, messages: AsyncIterator[pb2.LocalizeSequenceRequest], start: SequenceStart
    ) -> AsyncGenerator[Instant]:
        number, has_rig = 0, start.rig is not None
        async for message in messages:
            yield await asyncio.to_thread(
                instant_of, message, self._limits, number, has_rig=has_rig
            )
            number += 1

    async def ListMaps(  # noqa: N802
        self, request: pb2.ListMapsRequest, context: Context
    ) -> pb2.ListMapsResponse:
        """List the maps that can be opened, in the version that is served."""
        del request  # it says nothing
        async with _envelope("ListMaps", request_id(None), context):
            maps = [MapInfo.from_map(opened) for opened in await self._engine.maps()]
            return _message(ListMapsResponse(maps=maps), pb2.ListMapsResponse())

    async def GetMap(  # noqa: N802
        self, request: pb2.GetMapRequest, context: Context
    ) -> pb2.MapInfo:
        """Describe one map."""
        async with _envelope("GetMap", request_id(None), context):
            return _message(MapInfo.from_map(await self._engine.map(request.map)), pb2.MapInfo())


class GrpcServer:
    """The server with health and reflection; not serving until it is told to.

    Raises:
        RuntimeError: when the address cannot be bound.
    """

    def __init__(self, engine: Engine, settings: ServiceSettings) -> None:
        self._server = grpc.aio.server(
            options=[
                ("grpc.max_receive_message_length", settings.max_message_bytes),
                ("grpc.so_reuseport", 0),  # a second server on the port is a mistake
                # A robot that lost its network in the middle of a stream would keep its place.
                ("grpc.keepalive_time_ms", 60_000),
                ("grpc.keepalive_timeout_ms", 20_000),
                ("grpc.http2.max_pings_without_data", 0),
            ],
            maximum_concurrent_rpcs=settings.max_requests,
        )
        self._health = health.aio.HealthServicer()  # type: ignore[attr-defined]
        pb2_grpc.add_LocalizationServicer_to_server(
            LocalizationServicer(engine, settings), self._server
        )
        health_pb2_grpc.add_HealthServicer_to_server(self._health, self._server)
        reflection.enable_server_reflection(
            (SERVICE_NAME, health.SERVICE_NAME, reflection.SERVICE_NAME), self._server
        )
        host = f"[{settings.host}]" if ":" in settings.host else settings.host
        self.port = self._server.add_insecure_port(f"{host}:{settings.grpc_port}")

    async def start(self) -> None:
        """Accept calls. Health says NOT_SERVING."""
        await self._set_health(health_pb2.HealthCheckResponse.NOT_SERVING)
        await self._server.start()

    async def set_serving(self) -> None:
        """Let health say SERVING."""
        await self._set_health(health_pb2.HealthCheckResponse.SERVING)

    async def stop(self, grace_s: float) -> None:
        """Finish running calls, at most ``grace_s`` seconds long, and accept no new ones."""
        await self._health.enter_graceful_shutdown()
        await self._server.stop(grace_s)

    async def _set_health(self, status: health_pb2.HealthCheckResponse.ServingStatus) -> None:
        for name in ("", SERVICE_NAME):
            await self._health.set(name, status)


def _message(answer: BaseModel, message: MessageT) -> MessageT:
    """Fill a message from the model with the same fields: HTTP and gRPC answer the same."""
    return ParseDict(answer.model_dump(exclude_none=True), message)


@asynccontextmanager
async def _envelope(method: str, id_: str, context: Context) -> AsyncIterator[None]:
    """Turn errors into statuses with details, and write a line in the log."""
    started = perf_counter()
    code = grpc.StatusCode.CANCELLED
    try:
        try:
            await context.send_initial_metadata(((VERSION_KEY, visloc.__version__),))
            yield
            code = grpc.StatusCode.OK
        except VislocError as error:
            code = statuses_of(error)[1]
            await _abort(error, id_, context)
        except Exception:  # the last line of defence: gRPC would tell the caller what broke
            logger.exception("request %s broke", id_)
            code = grpc.StatusCode.INTERNAL
            await _abort(internal_error(), id_, context)
    finally:
        elapsed_ms = (perf_counter() - started) * 1000
        logger.info("grpc %s %s %.1f ms request_id=%s", method, code.name, elapsed_ms, id_)


async def _abort(error: VislocError, id_: str, context: Context) -> None:
    code = statuses_of(error)[1]
    details = {
        "kind": type(error).__name__,
        "message": error.message,
        "field": error.field,
        "expected": error.expected,
        "got": error.got,
        "request_id": id_,
    }
    info = ErrorInfo(
        reason=error.code,
        domain=ERROR_DOMAIN,
        metadata={
            name: str(value)[:_MAX_DETAIL] for name, value in details.items() if value is not None
        },
    )
    packed = AnyMessage()
    packed.Pack(info)
    text = str(error)[:_MAX_DETAIL]
    status = Status(code=code.value[0], message=text, details=[packed])
    await context.abort(
        code, text, trailing_metadata=(("grpc-status-details-bin", status.SerializeToString()),)
    )
