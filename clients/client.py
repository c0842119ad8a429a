"""One client, synchronous and asynchronous, over HTTP and gRPC.

Requests are built and answers are parsed in one place (``requests``, ``answers``); the transports
(``http``, ``grpc``) only carry them.
"""

from __future__ import annotations

import asyncio
from collections.abc import (
    AsyncGenerator,
    AsyncIterable,
    AsyncIterator,
    Iterable,
    Iterator,
    Mapping,
)
from contextlib import aclosing
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

from clients.errors import not_understood
from clients.transport.connection import checked_connection
from clients.transport.grpc import AsyncGrpcTransport, GrpcTransport
from clients.transport.http import AsyncHttpTransport, HttpTransport
from clients.transport.uploads import OnProgress, Upload, upload_request
from clients.wire import answers
from clients.wire.answers import InstantResult, LocalizeResult, ServerInfo
from clients.wire.features import PhotoOrFeatures
from clients.wire.requests import (
    CheckReady,
    DeleteVersion,
    GetServer,
    GetVersion,
    JsonObject,
    ListMaps,
    UseVersion,
    Where,
    checked_search,
    checked_version,
    get_map_request,
    localize_request,
)
from clients.wire.rig_requests import (
    AnyRequest,
    SentInstant,
    SequenceStart,
    check_time_unit,
    rig_request,
    sent_instant,
    sequence_start,
)
from clients.wire.rigs import Instant, Rig, RigImage
from clients.wire.types import LocalizeOptions
from visloc.geometry import Camera
from visloc.priors import Priors
from visloc.types import Near
from visloc_api.words.maps import MapInfo

DEFAULT_TIMEOUT_S = 60.0


class _Transport(Protocol):
    def send(self, request: AnyRequest) -> JsonObject: ...
    def stream(
        self, start: SequenceStart, instants: Iterable[SentInstant]
    ) -> Iterator[JsonObject]: ...
    def upload(self, upload: Upload, on_progress: OnProgress) -> JsonObject: ...
    def close(self) -> None: ...


class _AsyncTransport(Protocol):
    async def send(self, request: AnyRequest) -> JsonObject: ...
    def stream(
        self, start: SequenceStart, instants: AsyncIterable[SentInstant]
    ) -> AsyncGenerator[JsonObject, None]: ...
    async def upload(self, upload: Upload, on_progress: OnProgress) -> JsonObject: ...
    async def close(self) -> None: ...


class Client:
    """Asks a localization service; use it with ``with``, from any thread.

    Every method raises ``visloc.errors.VislocError``: what the server refuses as the server
    raised it, and ``Unavailable`` with a code ``server.*`` when no usable answer came.

    Args:
        server: ``http://host:port`` or ``grpc://host:port``; with TLS ``https://`` or
            ``grpcs://``.
        api_key: as the server's operator gave it; needed unless the server is on this machine and
            has no keys. Only TLS keeps it from being read on the way.
        ca: PEM file of the certificate authorities to trust, instead of the usual ones.
        timeout_s: longest wait for an answer, seconds. The server is told, and gives up then too.
    """

    def __init__(
        self,
        server: str,
        *,
        api_key: str | None = None,
        ca: str | Path | None = None,
        timeout_s: float = DEFAULT_TIMEOUT_S,
    ) -> None:
        connection = checked_connection(server, timeout_s, api_key, ca)
        self.server = server
        transport = GrpcTransport if connection.is_grpc else HttpTransport
        self._transport: _Transport = transport(connection)

    def localize(
        self,
        query: PhotoOrFeatures,
        map: Where,
        camera: Camera | None = None,
        options: LocalizeOptions | Mapping[str, Any] | None = None,
        request_id: str | None = None,
        *,
        priors: Priors | Mapping[str, Any] | None = None,
        ypr: bool = False,
        debug: bool = False,
    ) -> LocalizeResult:
        """Estimate the camera pose of one photo, or of its features.

        A photo that cannot be localized is an answer without a pose, not an error.

        Args:
            query: the encoded photo (JPEG, PNG, ...), the path of the file that holds it, or
                the features that were found in it, which need a camera.
            map: ``id`` or ``id@version``; of several, one answer counts, and
                a photo that two of them explain is refused as ambiguous; or those that
                are anchored around a place, as ``Near``.
            camera: intrinsics; without them the server uses EXIF, estimates or guesses, and says
                so.
            options: choices for this photo.
            request_id: names the request in the server's logs; made up there when None.
            priors: what is known of the camera, also as the API's JSON.
            ypr: also say the GeoPose in yaw, pitch and roll.
            debug: also return the matches and a picture of them (``LocalizeResult.debug``); needs a
                photo.
        """
        search = checked_search(map, options, priors, request_id, ypr=ypr)
        request = localize_request(search, query, camera, debug=debug)
        raw = self._transport.send(request)
        return answers.parse_answer(self.server, answers.parse_result, raw)

    def localize_rig(
        self,
        images: Iterable[RigImage],
        map: Where,
        rig: Rig,
        options: LocalizeOptions | Mapping[str, Any] | None = None,
        request_id: str | None = None,
        *,
        priors: Priors | Mapping[str, Any] | None = None,
        ypr: bool = False,
    ) -> InstantResult:
        """Estimate one pose from the photos that the cameras of a rig took at one instant.

        A photo that cannot be used fails alone: its ``error`` says why.

        Args:
            images: the photos, each of another camera; some may be missing.
            map: ``id`` or ``id@version``; of several, one answer counts, and
                a photo that two of them explain is refused as ambiguous; or those that
                are anchored around a place, as ``Near``.
            rig: how the cameras sit, or the id of a rig that the map knows (``MapInfo.rigs``).
            options: choices for this instant.
            request_id: names the request in the server's logs; made up there when None.
            priors: what is known of the rig, also as the API's JSON.
            ypr: also say the GeoPose in yaw, pitch and roll.
        """
        search = checked_search(map, options, priors, request_id, ypr=ypr)
        raw = self._transport.send(rig_request(search, rig, images))
        return answers.parse_answer(self.server, answers.parse_instant, raw)

    def localize_sequence(
        self,
        instants: Iterable[Instant],
        map: Where,
        rig: Rig | None = None,
        time_unit: str | None = None,
        max_gap_s: float | None = None,
        options: LocalizeOptions | Mapping[str, Any] | None = None,
        request_id: str | None = None,
        *,
        priors: Priors | Mapping[str, Any] | None = None,
        ypr: bool = False,
    ) -> Iterator[InstantResult]:
        """Estimate the poses of a sequence, each answered as soon as its answer is final.

        Over gRPC, the first instant is taken from ``instants`` before anything is sent, and the
        others as the server asks for them, in another thread. Over HTTP all instants are read
        before anything is sent: they go into one request. What ``instants`` raises is raised
        here, over gRPC after the answers to the instants before.

        With odometry an instant is answered when instants ``max_gap_s`` later, or 30 instants,
        have come, also when its own photos localize it: its neighbours may contradict it. Whoever
        waits for every answer before sending the next instant must use ``max_gap_s`` 0 or no
        odometry.

        Args:
            instants: in the order of time.
            map: ``id`` or ``id@version``; of several, that of the first pose is kept; or, as
                ``Near``, those that are anchored around a place.
            rig: how the cameras sit, or the id of a rig that the map knows; None when every
                instant is one photo of one camera.
            time_unit: of the timestamps, s, ms, us or ns; None tells it by their size, which must
                be that of Unix times.
            max_gap_s: longest time between measured instants across which poses are filled; None
                leaves it to the server, 0 fills none.
            options: choices for all instants.
            request_id: names the request in the server's logs; made up there when None.
            priors: what is known at every instant that has none of its own.
            ypr: also say the GeoPose in yaw, pitch and roll.
        """
        search = checked_search(map, options, priors, request_id, ypr=ypr)
        start = sequence_start(search, rig, time_unit, max_gap_s)
        return self._stream(start, instants)

    def maps(self, near: Near | None = None) -> list[MapInfo]:
        """List the maps that the server has: all, or the anchored ones that reach into a circle."""
        raw = self._transport.send(ListMaps(near))
        return answers.parse_answer(self.server, answers.parse_maps, raw)

    def map(self, map: str) -> MapInfo:
        """Describe one map, ``id`` or ``id@version``."""
        raw = self._transport.send(get_map_request(map))
        return answers.parse_answer(self.server, answers.parse_map, raw)

    def map_version(self, map_id: str, version: str) -> MapInfo:
        """Describe a version of a map, in use or not."""
        raw = self._transport.send(GetVersion(*checked_version(map_id, version)))
        return answers.parse_answer(self.server, answers.parse_map, raw)

    def upload_map(
        self,
        packed: str | Path,
        map_id: str | None = None,
        version: str | None = None,
        *,
        on_progress: OnProgress | None = None,
    ) -> MapInfo:
        """Publish a version of a map, which is not in use until ``use_version`` names it.

        The server reads and checks every byte before anyone can see it. When this is stopped or
        fails, nothing is left there. When the answer is lost, so that it is not known whether
        the map came through, ``map_version`` tells, or trying again: ``map.version_exists``.

        Args:
            packed: the file that ``mapping pack`` wrote.
            map_id: the map's id; None reads it from the file.
            version: the version's name; None reads it from the file.
            on_progress: is called with the number of bytes that were sent since the last call,
                over gRPC in another thread.
        """
        upload = upload_request(Path(packed), map_id, version)
        raw = self._transport.upload(upload, on_progress or _ignore)
        return answers.parse_answer(self.server, answers.parse_map, raw)

    def use_version(self, map_id: str, version: str) -> MapInfo:
        """Put a version of a map into use, a newer or an older one.

        Returns once the server answers with it. Requests that are under way are answered by the
        version that they began with.
        """
        raw = self._transport.send(UseVersion(*checked_version(map_id, version)))
        return answers.parse_answer(self.server, answers.parse_map, raw)

    def delete_version(self, map_id: str, version: str) -> None:
        """Delete a version of a map that is not in use, or the last one there is."""
        self._transport.send(DeleteVersion(*checked_version(map_id, version)))

    def server_info(self) -> ServerInfo:
        """Describe the server."""
        raw = self._transport.send(GetServer())
        return answers.parse_answer(self.server, answers.parse_server, raw)

    def ready(self) -> bool:
        """Tell whether the server has its maps loaded; raises when it cannot be reached."""
        raw = self._transport.send(CheckReady())
        return answers.parse_answer(self.server, answers.parse_ready, raw)

    def close(self) -> None:
        """Close the connections."""
        self._transport.close()

    def _stream(self, start: SequenceStart, instants: Iterable[Instant]) -> Iterator[InstantResult]:
        count = _Count(self.server, start.time_unit)
        for raw in self._transport.stream(start, map(count.sent, instants)):
            count.answers += 1
            yield answers.parse_answer(self.server, answers.parse_instant, raw)
        count.check()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()


class AsyncClient:
    """``Client`` for an event loop: the same methods, awaited; use it with ``async with``."""

    def __init__(
        self,
        server: str,
        *,
        api_key: str | None = None,
        ca: str | Path | None = None,
        timeout_s: float = DEFAULT_TIMEOUT_S,
    ) -> None:
        connection = checked_connection(server, timeout_s, api_key, ca)
        self.server = server
        transport = AsyncGrpcTransport if connection.is_grpc else AsyncHttpTransport
        self._transport: _AsyncTransport = transport(connection)

    async def localize(
        self,
        query: PhotoOrFeatures,
        map: Where,
        camera: Camera | None = None,
        options: LocalizeOptions | Mapping[str, Any] | None = None,
        request_id: str | None = None,
        *,
        priors: Priors | Mapping[str, Any] | None = None,
        ypr: bool = False,
        debug: bool = False,
    ) -> LocalizeResult:
        """As ``Client.localize``. A path is read in the loop; give bytes where that matters."""
        search = checked_search(map, options, priors, request_id, ypr=ypr)
        request = localize_request(search, query, camera, debug=debug)
        raw = await self._transport.send(request)
        return answers.parse_answer(self.server, answers.parse_result, raw)

    async def localize_rig(
        self,
        images: Iterable[RigImage],
        map: Where,
        rig: Rig,
        options: LocalizeOptions | Mapping[str, Any] | None = None,
        request_id: str | None = None,
        *,
        priors: Priors | Mapping[str, Any] | None = None,
        ypr: bool = False,
    ) -> InstantResult:
        """As ``Client.localize_rig``."""
        search = checked_search(map, options, priors, request_id, ypr=ypr)
        raw = await self._transport.send(rig_request(search, rig, images))
        return answers.parse_answer(self.server, answers.parse_instant, raw)

    def localize_sequence(
        self,
        instants: AsyncIterable[Instant] | Iterable[Instant],
        map: Where,
        rig: Rig | None = None,
        time_unit: str | None = None,
        max_gap_s: float | None = None,
        options: LocalizeOptions | Mapping[str, Any] | None = None,
        request_id: str | None = None,
        *,
        priors: Priors | Mapping[str, Any] | None = None,
        ypr: bool = False,
    ) -> AsyncIterator[InstantResult]:
        """As ``Client.localize_sequence``, for ``async for``."""
        search = checked_search(map, options, priors, request_id, ypr=ypr)
        start = sequence_start(search, rig, time_unit, max_gap_s)
        return self._stream(start, instants)

    async def maps(self, near: Near | None = None) -> list[MapInfo]:
        """As ``Client.maps``."""
        raw = await self._transport.send(ListMaps(near))
        return answers.parse_answer(self.server, answers.parse_maps, raw)

    async def map(self, map: str) -> MapInfo:
        """As ``Client.map``."""
        raw = await self._transport.send(get_map_request(map))
        return answers.parse_answer(self.server, answers.parse_map, raw)

    async def map_version(self, map_id: str, version: str) -> MapInfo:
        """As ``Client.map_version``."""
        raw = await self._transport.send(GetVersion(*checked_version(map_id, version)))
        return answers.parse_answer(self.server, answers.parse_map, raw)

    async def upload_map(
        self,
        packed: str | Path,
        map_id: str | None = None,
        version: str | None = None,
        *,
        on_progress: OnProgress | None = None,
    ) -> MapInfo:
        """As ``Client.upload_map``."""
        upload = await asyncio.to_thread(upload_request, Path(packed), map_id, version)
        raw = await self._transport.upload(upload, on_progress or _ignore)
        return answers.parse_answer(self.server, answers.parse_map, raw)

    async def use_version(self, map_id: str, version: str) -> MapInfo:
        """As ``Client.use_version``."""
        raw = await self._transport.send(UseVersion(*checked_version(map_id, version)))
        return answers.parse_answer(self.server, answers.parse_map, raw)

    async def delete_version(self, map_id: str, version: str) -> None:
        """As ``Client.delete_version``."""
        await self._transport.send(DeleteVersion(*checked_version(map_id, version)))

    async def server_info(self) -> ServerInfo:
        """As ``Client.server_info``."""
        raw = await self._transport.send(GetServer())
        return answers.parse_answer(self.server, answers.parse_server, raw)

    async def ready(self) -> bool:
        """As ``Client.ready``."""
        raw = await self._transport.send(CheckReady())
        return answers.parse_answer(self.server, answers.parse_ready, raw)

    async def close(self) -> None:
        """Close the connections."""
        await self._transport.close()

    async def _stream(
        self, start: SequenceStart, instants: AsyncIterable[Instant] | Iterable[Instant]
    ) -> AsyncIterator[InstantResult]:
        count = _Count(self.server, start.time_unit)

        async def sent() -> AsyncIterator[SentInstant]:
            if isinstance(instants, AsyncIterable):
                async for instant in instants:
                    yield count.sent(instant)
            else:
                for instant in instants:
                    yield count.sent(instant)

        async with aclosing(self._transport.stream(start, sent())) as stream:
            async for raw in stream:
                count.answers += 1
                yield answers.parse_answer(self.server, answers.parse_instant, raw)
        count.check()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        await self.close()


class _Count:
    """Checks the instants one after the other, and holds a server to one answer for each."""

    def __init__(self, server: str, time_unit: str | None) -> None:
        self._server, self._time_unit = server, time_unit
        self._instants = 0
        self.answers = 0

    def sent(self, instant: Instant) -> SentInstant:
        sent = sent_instant(instant, self._instants)
        if self._instants == 0:
            check_time_unit(self._time_unit, sent.timestamp)
        self._instants += 1
        return sent

    def check(self) -> None:
        if self.answers != self._instants:
            got = f"{self.answers} answers to {self._instants} instants"
            raise not_understood(self._server, got)


def _ignore(_: int) -> None:
    pass
