"""One client over HTTP and gRPC: asynchronous, and for callers that wait.

``clients.wire`` builds requests and parses answers; ``clients.transport`` carries them.
"""

from __future__ import annotations

from collections.abc import (
    AsyncGenerator,
    AsyncIterable,
    Callable,
    Coroutine,
    Iterable,
    Iterator,
    Mapping,
)
from contextlib import aclosing
from functools import partial, wraps
from pathlib import Path
from types import TracebackType
from typing import Any, Concatenate, ParamSpec, Protocol, Self, TypeVar

from clients.errors import not_understood
from clients.transport.blocking import read_items, run_blocking
from clients.transport.connection import checked_connection
from clients.transport.http import HttpTransport
from clients.transport.loop_thread import LoopThread
from clients.transport.uploads import OnProgress, Upload, upload_request
from clients.wire import answers
from clients.wire.answers import InstantResult, LocalizeResult, ServerInfo
from clients.wire.features import PhotoOrFeatures
from clients.wire.requests import (
    CheckReady,
    DeleteVersion,
    GetImages,
    GetServer,
    GetVersion,
    JsonObject,
    ListMaps,
    Request,
    StartSequence,
    UseVersion,
    Where,
    check_time_unit,
    checked_search,
    checked_version,
    get_map_request,
    instant_words,
    photo_request,
    read_query,
    rig_request,
    sequence_start,
)
from clients.wire.rigs import Instant, Rig, RigImage
from visloc.geometry import Camera
from visloc.priors import Priors
from visloc.types import Near
from visloc_api.words import sequences
from visloc_api.words.maps import MapInfo
from visloc_api.words.options import LocalizeOptions
from visloc_api.words.scenes import MapImages

P = ParamSpec("P")
T = TypeVar("T")

DEFAULT_TIMEOUT_S = 60.0


class _Transport(Protocol):
    async def send(self, request: Request) -> JsonObject: ...
    def stream(
        self, start: StartSequence, instants: AsyncIterable[sequences.Instant]
    ) -> AsyncGenerator[JsonObject, None]: ...
    async def upload(self, upload: Upload, on_progress: OnProgress) -> JsonObject: ...
    async def close(self) -> None: ...


class AsyncClient:
    """Asks a localization service from an event loop; use it with ``async with``.

    Every method raises ``visloc.errors.VislocError``: the server's refusals as the server raised
    them, and ``Unavailable`` with a code ``server.*`` when no usable answer came.

    Args:
        server: ``http://host:port`` or ``grpc://host:port``; with TLS ``https://`` or
            ``grpcs://``.
        api_key: from the server's operator; needed unless the server is on this machine and has
            no keys. Without TLS it is sent in clear text.
        ca: PEM file of the certificate authorities to trust instead of the usual ones.
        timeout_s: longest wait for an answer, seconds. The server gets the same limit.
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
        self._transport: _Transport
        if connection.is_grpc:
            # Imported here, because gRPC takes a third of the time of ``import clients``.
            from clients.transport.grpc import GrpcTransport

            self._transport = GrpcTransport(connection)
        else:
            self._transport = HttpTransport(connection)

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
        """Estimate the camera pose of one photo, or of its features.

        A photo that cannot be localized is an answer without a pose, not an error.

        Args:
            query: the encoded photo (JPEG, PNG, ...), the path of its file, a ``MaskedImage``, or
                the features that were found in it, which need a camera.
            map: ``id`` or ``id@version``, or several: one of them answers, and a photo that fits
                two of them is refused as ambiguous. Or ``Near``: the anchored maps around a place.
            camera: intrinsics. Without them the server uses EXIF, estimates or guesses; the answer
                says which.
            options: choices for this photo.
            request_id: names the request in the server's logs; None lets the server choose.
            priors: what is known of the camera, also as the API's JSON.
            ypr: also return the GeoPose in yaw, pitch and roll.
            debug: also return the matches and a picture of them (``LocalizeResult.debug``); needs
                a photo.
        """
        search = checked_search(map, options, priors, request_id, ypr=ypr)
        if isinstance(query, str | Path):
            query = await run_blocking(partial(read_query, query))
        request = photo_request(search, query, camera, debug=debug)
        return await self._ask(request, answers.parse_result)

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
        """Estimate one pose from the photos that the cameras of a rig took at one instant.

        A photo that cannot be used fails alone: its ``error`` says why.

        Args:
            images: the photos, each of another camera; some may be missing.
            map: as for ``localize``.
            rig: the poses of the cameras, or the id of a rig that the map knows (``MapInfo.rigs``).
            options: choices for this instant.
            request_id: names the request in the server's logs; None lets the server choose.
            priors: what is known of the rig, also as the API's JSON.
            ypr: also return the GeoPose in yaw, pitch and roll.
        """
        search = checked_search(map, options, priors, request_id, ypr=ypr)
        request = await run_blocking(partial(rig_request, search, rig, images))
        return await self._ask(request, answers.parse_instant)

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
    ) -> AsyncGenerator[InstantResult, None]:
        """Estimate the poses of a sequence, each answered as soon as its answer is final.

        Over gRPC, the first instant is read before anything is sent, the others when the server
        asks for them, from a synchronous iterable in other threads. Over HTTP, all instants are
        read first and sent in one request. An error of ``instants`` is raised here; over gRPC, the
        answers to earlier instants come first.

        With odometry, an answer waits for the instants of the next ``max_gap_s``, at most 30, even
        if its own photos localize it: they may contradict it. A caller that waits for every answer
        before sending the next instant must use ``max_gap_s`` 0 or no odometry.

        Args:
            instants: in the order of time.
            map: as for ``localize``; of several maps, the one of the first pose is kept.
            rig: the poses of the cameras, or the id of a rig that the map knows; None when every
                instant is one photo of one camera.
            time_unit: of the timestamps: s, ms, us or ns; None infers it from their size, which
                must be that of Unix times.
            max_gap_s: longest time between measured instants across which poses are filled; None
                leaves it to the server, 0 fills none.
            options: choices for all instants.
            request_id: names the request in the server's logs; None lets the server choose.
            priors: what is known at every instant that has none of its own.
            ypr: also return the GeoPose in yaw, pitch and roll.
        """
        search = checked_search(map, options, priors, request_id, ypr=ypr)
        start = sequence_start(search, rig, time_unit, max_gap_s)
        return self._stream(start, time_unit, instants)

    async def maps(self, near: Near | None = None) -> list[MapInfo]:
        """List the server's maps: all, or the anchored ones that reach into a circle."""
        return await self._ask(ListMaps(near), answers.parse_maps)

    async def map(self, map: str) -> MapInfo:
        """Describe one map, ``id`` or ``id@version``."""
        return await self._ask(get_map_request(map), answers.parse_map)

    async def images(self, map: str, first: int = 0, count: int = 1000) -> MapImages:
        """Tell where photos of a map were taken, and by which cameras; over HTTP only.

        ``images.cameras[id].camera`` is what to send with a photo that this camera took: it is more
        exact than EXIF.

        Args:
            map: ``id`` or ``id@version``; not a set, whose photos belong to its tiles.
            first: place in the map's order to begin at; ``images.total`` says how many there are.
            count: most photos, 1 to 10 000.
        """
        asked = GetImages(get_map_request(map).map, first, count)
        return await self._ask(asked, MapImages.model_validate)

    async def map_version(self, map_id: str, version: str) -> MapInfo:
        """Describe a version of a map, current or not."""
        return await self._ask(GetVersion(*checked_version(map_id, version)), answers.parse_map)

    async def upload_map(
        self,
        packed: str | Path,
        map_id: str | None = None,
        version: str | None = None,
        *,
        on_progress: OnProgress | None = None,
    ) -> MapInfo:
        """Publish a version of a map; it is not current until ``use_version`` names it.

        The server reads and checks every byte before anyone can see the version. An upload that is
        stopped or fails leaves nothing there. When the answer is lost, ``map_version`` tells
        whether the version was published; uploading again fails with ``map.version_exists`` then.

        Args:
            packed: the file that ``mapping pack`` wrote.
            map_id: the map's id; None reads it from the file.
            version: the version's name; None reads it from the file.
            on_progress: is called with the number of bytes that were sent since the last call,
                over gRPC, and by ``Client``, in another thread.
        """
        upload = await run_blocking(partial(upload_request, Path(packed), map_id, version))
        raw = await self._transport.upload(upload, on_progress or _ignore)
        return answers.parse_answer(self.server, answers.parse_map, raw)

    async def use_version(self, map_id: str, version: str) -> MapInfo:
        """Make a version of a map current, a newer or an older one.

        Returns once the server answers with it. Requests that are under way are answered by the
        version that they began with.
        """
        return await self._ask(UseVersion(*checked_version(map_id, version)), answers.parse_map)

    async def delete_version(self, map_id: str, version: str) -> None:
        """Delete a version of a map that is not current, or the last one there is."""
        await self._transport.send(DeleteVersion(*checked_version(map_id, version)))

    async def server_info(self) -> ServerInfo:
        """Describe the server."""
        return await self._ask(GetServer(), answers.parse_server)

    async def ready(self) -> bool:
        """Return whether the server has its maps loaded; raises when it cannot be reached."""
        return await self._ask(CheckReady(), answers.parse_ready)

    async def close(self) -> None:
        """Close the connections."""
        await self._transport.close()

    async def _ask(self, request: Request, parse: Callable[[JsonObject], T]) -> T:
        return answers.parse_answer(self.server, parse, await self._transport.send(request))

    async def _stream(
        self,
        start: StartSequence,
        time_unit: str | None,
        instants: AsyncIterable[Instant] | Iterable[Instant],
    ) -> AsyncGenerator[InstantResult, None]:
        count = _Count(self.server, time_unit)
        if isinstance(instants, AsyncIterable):
            sent = (count.sent(instant) async for instant in instants)
        else:
            sent = read_items(map(count.sent, instants))
        async with aclosing(self._transport.stream(start, sent)) as stream:
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


def _waiting(
    method: Callable[Concatenate[AsyncClient, P], Coroutine[Any, Any, T]],
) -> Callable[Concatenate[Client, P], T]:
    """Make a method of ``Client`` that waits for a method of ``AsyncClient``."""

    @wraps(method)
    def wait(client: Client, /, *args: P.args, **kwargs: P.kwargs) -> T:
        return client._loop_thread.run(lambda asked: method(asked, *args, **kwargs))

    return wait


def _iterating(
    method: Callable[Concatenate[AsyncClient, P], AsyncGenerator[T, None]],
) -> Callable[Concatenate[Client, P], Iterator[T]]:
    """Make a method of ``Client`` that iterates over a method of ``AsyncClient``."""

    @wraps(method)
    def iterate(client: Client, /, *args: P.args, **kwargs: P.kwargs) -> Iterator[T]:
        thread = client._loop_thread
        return thread.iterate(method(thread.client, *args, **kwargs))

    return iterate


class Client:
    """``AsyncClient`` for callers that wait: the same methods, without ``await``.

    Use it with ``with``, from any thread, also where an event loop runs. A thread of its own sends
    the requests and ends with it. Ctrl-C ends a call. In a process that was forked after the first
    call, HTTP still works and gRPC raises RuntimeError.
    """

    def __init__(
        self,
        server: str,
        *,
        api_key: str | None = None,
        ca: str | Path | None = None,
        timeout_s: float = DEFAULT_TIMEOUT_S,
    ) -> None:
        self.server = server
        self._loop_thread = LoopThread(
            partial(AsyncClient, server, api_key=api_key, ca=ca, timeout_s=timeout_s)
        )

    localize = _waiting(AsyncClient.localize)
    localize_rig = _waiting(AsyncClient.localize_rig)
    localize_sequence = _iterating(AsyncClient.localize_sequence)
    maps = _waiting(AsyncClient.maps)
    map = _waiting(AsyncClient.map)
    images = _waiting(AsyncClient.images)
    map_version = _waiting(AsyncClient.map_version)
    upload_map = _waiting(AsyncClient.upload_map)
    use_version = _waiting(AsyncClient.use_version)
    delete_version = _waiting(AsyncClient.delete_version)
    server_info = _waiting(AsyncClient.server_info)
    ready = _waiting(AsyncClient.ready)

    def close(self) -> None:
        """Close the connections; calls that wait in other threads end with a RuntimeError."""
        self._loop_thread.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()


class _Count:
    """Checks instants as they are sent, and checks that the server answers each exactly once."""

    def __init__(self, server: str, time_unit: str | None) -> None:
        self._server, self._time_unit = server, time_unit
        self._instants = 0
        self.answers = 0

    def sent(self, instant: Instant) -> sequences.Instant:
        sent = instant_words(instant, self._instants)
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
