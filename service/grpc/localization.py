"""The gRPC door."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import aclosing

import grpc
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from service.api import BatchLimits, ListMapsResponse
from service.api.answers import instant_answer, localize_response
from service.api.deadlines import within
from service.api.maps import map_info
from service.engine.engine import Engine
from service.errors import request_id
from service.grpc.access import AccessInterceptor
from service.grpc.connections import GrpcConnections
from service.grpc.envelope import Context, Envelope, message_of
from service.grpc.maps import MAPS_SERVICE_NAME, MapsServicer
from service.grpc.messages import (
    instant_of,
    localize_job_of,
    near_of,
    rig_job_of,
    sequence_start_of,
)
from service.http.slow_clients import TimelyCalls
from service.security.access import Access
from service.security.tls import grpc_credentials
from service.settings import ServiceSettings
from service.telemetry.observer import Observer
from service.values import Instant, SequenceStart
from visloc_api.v1 import localization_pb2 as pb2
from visloc_api.v1 import localization_pb2_grpc as pb2_grpc

SERVICE_NAME = pb2.DESCRIPTOR.services_by_name["Localization"].full_name


class LocalizationServicer(pb2_grpc.LocalizationServicer):
    """``visloc.v1.Localization`` over the engine."""

    def __init__(self, engine: Engine, settings: ServiceSettings, observer: Observer) -> None:
        self._engine = engine
        self._observer = observer
        self._envelope = Envelope(observer)
        self._timeout_s, self._patience_s = settings.request_timeout_s, settings.arrival_timeout_s
        self._max_request_bytes = settings.max_request_bytes
        self._limits = BatchLimits(settings.max_rig_images, settings.max_instants)

    async def Localize(  # noqa: N802  the name in the proto
        self, request: pb2.LocalizeRequest, context: Context
    ) -> pb2.LocalizeResponse:
        """Estimate the camera pose of one photo, or of its features, in one map."""
        id_ = request_id(request.request_id)
        async with self._envelope("Localize", id_, context):
            # Features take a moment to check: off the event loop with them.
            async with within(self._timeout_s):
                job = await asyncio.to_thread(localize_job_of, request, self._max_request_bytes)
                found = await self._engine.localize(job)
            self._observer.localization(found)
            answer = localize_response(found, id_)
            return message_of(answer, pb2.LocalizeResponse())

    async def LocalizeRig(  # noqa: N802
        self, request: pb2.LocalizeRigRequest, context: Context
    ) -> pb2.InstantAnswer:
        """Estimate one pose from the photos that the cameras of a rig took at one instant."""
        id_ = request_id(request.request_id)
        async with self._envelope("LocalizeRig", id_, context):
            with self._engine.admit_batch():
                async with within(self._timeout_s):
                    job = await asyncio.to_thread(rig_job_of, request, self._limits)
                    found = await self._engine.localize_rig(job)
            self._observer.instant(found)
            return message_of(instant_answer(found, id_), pb2.InstantAnswer())

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
        async with self._envelope("LocalizeSequence", id_, context, streams=True):
            start = await asyncio.to_thread(sequence_start_of, first)
            with self._engine.admit_batch():
                async with (
                    aclosing(self._instants(request_iterator, start)) as instants,
                    aclosing(self._engine.localize_sequence(start, instants)) as answers,
                ):
                    async for found in answers:
                        self._observer.instant(found)
                        answer = instant_answer(found, id_)
                        async with within(self._patience_s):
                            await context.write(message_of(answer, pb2.InstantAnswer()))

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
        async with self._envelope("ListMaps", request_id(None), context):
            served = await self._engine.maps(near_of(request))

            def answer() -> pb2.ListMapsResponse:
                maps = tuple(map_info(each, in_list=True) for each in served)
                return message_of(ListMapsResponse(maps=maps), pb2.ListMapsResponse())

            # Of ten thousand maps, it takes a moment.
            return await asyncio.to_thread(answer)

    async def GetMap(  # noqa: N802
        self, request: pb2.GetMapRequest, context: Context
    ) -> pb2.MapInfo:
        """Describe one map."""
        async with self._envelope("GetMap", request_id(None), context):
            served = await self._engine.map(request.map)
            # Of a set with ten thousand tiles, it takes a moment.
            info = await asyncio.to_thread(map_info, served)
            return message_of(info, pb2.MapInfo())


class GrpcServer:
    """The server with health and reflection; not serving until it is told to.

    Raises:
        RuntimeError: when the address cannot be bound.
    """

    def __init__(
        self, engine: Engine, settings: ServiceSettings, observer: Observer, access: Access
    ) -> None:
        envelope = Envelope(observer)
        self._connections = GrpcConnections(settings.max_connections)
        patience_s = settings.arrival_timeout_s
        self._server = grpc.aio.server(
            interceptors=[
                AccessInterceptor(access, envelope, max(1, settings.max_connections // 2)),
                TimelyCalls(envelope, self._connections, patience_s, settings.max_message_bytes),
            ],
            options=[
                ("grpc.max_receive_message_length", settings.max_message_bytes),
                *self._connections.options,
                # Of a connection that says nothing, or not what HTTP/2 begins with.
                ("grpc.server_handshake_timeout_ms", round(1000 * patience_s)),
                ("grpc.so_reuseport", 0),  # a second server on the port is a mistake
                # A robot that lost its network in the middle of a stream would keep its place.
                ("grpc.keepalive_time_ms", 60_000),
                ("grpc.keepalive_timeout_ms", 20_000),
                ("grpc.http2.max_pings_without_data", 0),
            ],
            maximum_concurrent_rpcs=settings.max_connections,
        )
        self._health = health.aio.HealthServicer()  # type: ignore[attr-defined]
        pb2_grpc.add_LocalizationServicer_to_server(
            LocalizationServicer(engine, settings, observer), self._server
        )
        pb2_grpc.add_MapsServicer_to_server(MapsServicer(engine, observer), self._server)
        health_pb2_grpc.add_HealthServicer_to_server(self._health, self._server)
        reflection.enable_server_reflection(
            (SERVICE_NAME, MAPS_SERVICE_NAME, health.SERVICE_NAME, reflection.SERVICE_NAME),
            self._server,
        )
        host = f"[{settings.host}]" if ":" in settings.host else settings.host
        address, credentials = f"{host}:{settings.grpc_port}", grpc_credentials(settings)
        if credentials is None:
            self.port = self._server.add_insecure_port(address)
        else:
            self.port = self._server.add_secure_port(address, credentials)

    async def start(self) -> None:
        """Accept calls. Health says NOT_SERVING."""
        await self._set_health(health_pb2.HealthCheckResponse.NOT_SERVING)
        await self._server.start()
        self._watching = asyncio.create_task(self._connections.watch(self.port))

    async def set_serving(self) -> None:
        """Let health say SERVING."""
        await self._set_health(health_pb2.HealthCheckResponse.SERVING)

    async def set_not_serving(self) -> None:
        """Let health say NOT_SERVING."""
        await self._set_health(health_pb2.HealthCheckResponse.NOT_SERVING)

    async def stop(self, grace_s: float) -> None:
        """Finish running calls, at most ``grace_s`` seconds long, and accept no new ones."""
        await self._health.enter_graceful_shutdown()
        await self._server.stop(grace_s)
        self._watching.cancel()

    async def _set_health(self, status: health_pb2.HealthCheckResponse.ServingStatus) -> None:
        for name in ("", SERVICE_NAME, MAPS_SERVICE_NAME):
            await self._health.set(name, status)
