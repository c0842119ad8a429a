"""One client, synchronous and asynchronous, over HTTP and gRPC.

Requests are built and answers are parsed in one place (``requests``, ``answers``); the transports
(``http``, ``grpc``) only carry them.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import TracebackType
from typing import Any, Protocol, Self

from clients import answers
from clients.grpc import AsyncGrpcTransport, GrpcTransport
from clients.http import AsyncHttpTransport, HttpTransport
from clients.requests import (
    CheckReady,
    GetServer,
    JsonObject,
    ListMaps,
    PhotoOrFeatures,
    Request,
    checked_server,
    get_map_request,
    localize_request,
)
from clients.types import LocalizeOptions, LocalizeResult, MapInfo, ServerInfo
from visloc.geometry import Camera

DEFAULT_TIMEOUT_S = 60.0


class _Transport(Protocol):
    def send(self, request: Request) -> JsonObject: ...
    def close(self) -> None: ...


class _AsyncTransport(Protocol):
    async def send(self, request: Request) -> JsonObject: ...
    async def close(self) -> None: ...


class Client:
    """Asks a localization service; use it with ``with``, from any thread.

    Every method raises ``visloc.errors.VislocError``: what the server refuses as the server
    raised it, and ``Unavailable`` with a code ``server.*`` when no usable answer came.

    Args:
        server: ``http://host:port``, ``https://host:port`` or ``grpc://host:port``.
        timeout_s: longest wait for an answer, seconds.
    """

    def __init__(self, server: str, *, timeout_s: float = DEFAULT_TIMEOUT_S) -> None:
        self.server = checked_server(server)
        transport = GrpcTransport if server.startswith("grpc:") else HttpTransport
        self._transport: _Transport = transport(server, timeout_s)

    def localize(
        self,
        query: PhotoOrFeatures,
        map: str,
        camera: Camera | None = None,
        options: LocalizeOptions | Mapping[str, Any] | None = None,
        request_id: str | None = None,
    ) -> LocalizeResult:
        """Estimate the camera pose of one photo, or of its features, in one map.

        A photo that cannot be localized is an answer without a pose, not an error.

        Args:
            query: the encoded photo (JPEG, PNG, ...), the path of the file that holds it, or
                the features that were found in it, which need a camera.
            map: ``id`` or ``id@version``.
            camera: intrinsics; without them the server uses EXIF or guesses, and says so.
            options: choices for this photo.
            request_id: names the request in the server's logs; made up there when None.
        """
        request = localize_request(query, map, camera, options, request_id)
        raw = self._transport.send(request)
        return answers.parse_answer(self.server, answers.parse_result, raw)

    def maps(self) -> list[MapInfo]:
        """List the maps that the server has."""
        raw = self._transport.send(ListMaps())
        return answers.parse_answer(self.server, answers.parse_maps, raw)

    def map(self, map: str) -> MapInfo:
        """Describe one map, ``id`` or ``id@version``."""
        raw = self._transport.send(get_map_request(map))
        return answers.parse_answer(self.server, answers.parse_map, raw)

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

    def __init__(self, server: str, *, timeout_s: float = DEFAULT_TIMEOUT_S) -> None:
        self.server = checked_server(server)
        transport = AsyncGrpcTransport if server.startswith("grpc:") else AsyncHttpTransport
        self._transport: _AsyncTransport = transport(server, timeout_s)

    async def localize(
        self,
        query: PhotoOrFeatures,
        map: str,
        camera: Camera | None = None,
        options: LocalizeOptions | Mapping[str, Any] | None = None,
        request_id: str | None = None,
    ) -> LocalizeResult:
        """As ``Client.localize``. A path is read in the loop; give bytes where that matters."""
        request = localize_request(query, map, camera, options, request_id)
        raw = await self._transport.send(request)
        return answers.parse_answer(self.server, answers.parse_result, raw)

    async def maps(self) -> list[MapInfo]:
        """As ``Client.maps``."""
        raw = await self._transport.send(ListMaps())
        return answers.parse_answer(self.server, answers.parse_maps, raw)

    async def map(self, map: str) -> MapInfo:
        """As ``Client.map``."""
        raw = await self._transport.send(get_map_request(map))
        return answers.parse_answer(self.server, answers.parse_map, raw)

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

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        await self.close()
