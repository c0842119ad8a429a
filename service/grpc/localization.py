"""Photos, rigs and sequences over gRPC."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import aclosing

from service.api.answers import instant_answer, localize_response
from service.api.deadlines import TimeLimit, request_id, within
from service.api.maps import map_info
from service.engine.engine import Engine
from service.grpc.envelope import Context, Envelope, message_of
from service.grpc.messages import (
    instant_of,
    localize_job_of,
    near_of,
    rig_job_of,
    sequence_start_of,
)
from service.grpc.reading import converted
from service.settings import ServiceSettings
from service.telemetry.observer import Observer
from service.values import InstantJob, SequenceJob
from visloc_api.v1 import localization_pb2 as pb2
from visloc_api.v1 import localization_pb2_grpc as pb2_grpc
from visloc_api.words.maps import ListMapsResponse
from visloc_api.words.rigs import BatchLimits


class LocalizationServicer(pb2_grpc.LocalizationServicer):
    """``visloc.v1.Localization`` over the engine."""

    def __init__(self, engine: Engine, settings: ServiceSettings, observer: Observer) -> None:
        self._engine = engine
        self._observer = observer
        self._envelope = Envelope(observer)
        self._limit = TimeLimit(settings.request_timeout_s)
        # A client that takes no answers is slow, not the server.
        self._taking = TimeLimit(settings.arrival_timeout_s, is_callers=True)
        self._max_request_bytes = settings.max_request_bytes
        self._limits = BatchLimits(settings.max_rig_images, settings.max_instants)

    async def Localize(  # noqa: N802  the name in the proto
        self, request: pb2.LocalizeRequest, context: Context
    ) -> pb2.LocalizeResponse:
        """Estimate the camera pose of one photo, or of its features, in one map."""
        id_ = request_id(request.request_id)
        async with self._envelope("Localize", id_, context):
            # Features take a moment to check: not on the event loop.
            async with within(self._limit):
                job = await converted(localize_job_of, request, self._max_request_bytes)
                found = await self._engine.localize(job)
            self._observer.localization(found)
            answer = localize_response(found, id_)
            return message_of(answer, pb2.LocalizeResponse())

    async def LocalizeRig(  # noqa: N802
        self, request: pb2.LocalizeRigRequest, context: Context
    ) -> pb2.InstantAnswer:
        """Estimate one pose from photos that the cameras of a rig took at the same time."""
        id_ = request_id(request.request_id)
        async with self._envelope("LocalizeRig", id_, context):
            with self._engine.admit_batch():
                async with within(self._limit):
                    job = await converted(rig_job_of, request, self._limits)
                    found = await self._engine.localize_rig(job)
            self._observer.instant(found)
            return message_of(instant_answer(found, id_), pb2.InstantAnswer())

    # A coroutine that writes, not a generator: it always ends before the slot that it holds goes to
    # another call.
    async def LocalizeSequence(  # type: ignore[override]  # noqa: N802
        self, request_iterator: AsyncIterator[pb2.LocalizeSequenceRequest], context: Context
    ) -> None:
        """Answer the instants of a sequence in order, each as soon as its answer is final.

        An instant is read from the wire only after the client took the earlier answers.
        """
        first = await anext(request_iterator, None)
        id_ = request_id(first.start.request_id if first is not None else None)
        async with self._envelope("LocalizeSequence", id_, context, streams=True):
            start = await converted(sequence_start_of, first)
            with self._engine.admit_batch():
                async with (
                    aclosing(self._instants(request_iterator, start)) as instants,
                    aclosing(self._engine.localize_sequence(start, instants)) as answers,
                ):
                    async for found in answers:
                        self._observer.instant(found)
                        answer = instant_answer(found, id_)
                        async with within(self._taking):
                            await context.write(message_of(answer, pb2.InstantAnswer()))

    async def _instants(
        self, messages: AsyncIterator[pb2.LocalizeSequenceRequest], start: SequenceJob
    ) -> AsyncGenerator[InstantJob]:
        number, has_rig = 0, start.rig is not None
        async for message in messages:
            yield await converted(instant_of, message, self._limits, number, has_rig=has_rig)
            number += 1

    async def ListMaps(  # noqa: N802
        self, request: pb2.ListMapsRequest, context: Context
    ) -> pb2.ListMapsResponse:
        """List the maps that can be opened, each in its current version."""
        async with self._envelope("ListMaps", request_id(None), context):
            served = await self._engine.maps(near_of(request))

            def answer() -> pb2.ListMapsResponse:
                maps = tuple(map_info(each, in_list=True) for each in served)
                return message_of(ListMapsResponse(maps=maps), pb2.ListMapsResponse())

            return await asyncio.to_thread(answer)  # slow for ten thousand maps

    async def GetMap(  # noqa: N802
        self, request: pb2.GetMapRequest, context: Context
    ) -> pb2.MapInfo:
        """Describe one map."""
        async with self._envelope("GetMap", request_id(None), context):
            served = await self._engine.map(request.map)
            # Slow for a set of ten thousand tiles.
            info = await asyncio.to_thread(map_info, served)
            return message_of(info, pb2.MapInfo())
