"""Requests over both doors, and their answers in a form that can be compared."""

from __future__ import annotations

import json
import struct
import uuid
import zlib
from base64 import b64encode
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from types import TracebackType
from typing import Any, Self, cast

import grpc
import httpx
from google.protobuf.json_format import MessageToDict
from google.rpc.error_details_pb2 import ErrorInfo
from google.rpc.status_pb2 import Status

from benchmarks.reliability.maps import Photo, SampleMaps
from benchmarks.reliability.service_process import Addresses
from visloc.geometry import Camera
from visloc_api.v1.localization_pb2 import Camera as WireCamera
from visloc_api.v1.localization_pb2 import LocalizeRequest
from visloc_api.v1.localization_pb2_grpc import LocalizationStub

NO_ANSWER = "no answer"
# What a full queue says over HTTP and over gRPC.
BUSY = frozenset({"429 server.busy", "RESOURCE_EXHAUSTED server.busy"})
# Different in every answer.
_OF_THE_REQUEST = ("request_id", "seconds")
_ANSWER_WITHIN_S = 90


@dataclass(frozen=True)
class Outcome:
    """What came of a request.

    Attributes:
        status: ``200``, ``422 map.unknown``, ``OK``, ``NOT_FOUND map.unknown``; ``no answer`` and
            why when the connection broke.
        body: the answer as JSON, without what differs between equal answers.
        own: whether the answer has the id of the request, where answers have one.
        retry_after: whether the answer says when to try again.
        seconds: that it took.
    """

    status: str
    body: str
    own: bool
    retry_after: bool
    seconds: float

    @property
    def is_busy(self) -> bool:
        """Whether it was refused because others were before it."""
        return self.status in BUSY

    @property
    def is_lost(self) -> bool:
        """Whether there was no answer."""
        return self.status.startswith(NO_ANSWER)


class Doors:
    """Connections to both doors of a service."""

    def __init__(self, service: Addresses) -> None:
        # No limits: the requests that wait are the test.
        limits = httpx.Limits(max_connections=None, max_keepalive_connections=64)
        self.http = httpx.AsyncClient(base_url=service.url, timeout=_ANSWER_WITHIN_S, limits=limits)
        self._channel = channel_to(
            service,
            ("grpc.initial_reconnect_backoff_ms", 200),
            ("grpc.max_reconnect_backoff_ms", 500),
        )
        self.stub = LocalizationStub(self._channel)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        await self.http.aclose()
        await self._channel.close(None)


def channel_to(service: Addresses, *options: tuple[str, int]) -> grpc.aio.Channel:
    """Open a channel."""
    return grpc.aio.insecure_channel(service.grpc, options=options)


@dataclass(frozen=True)
class Case:
    """A request that can be sent again and again.

    Attributes:
        name: of it.
        send: sends it with an id and returns status, answer, the id that came back, and whether
            it says when to try again.
    """

    name: str
    send: Callable[[Doors, str], Awaitable[tuple[str, Any, str, bool]]]

    async def ask(self, doors: Doors, id_: str | None = None) -> Outcome:
        """Send it and wait for what comes of it."""
        id_ = id_ or uuid.uuid4().hex
        started = perf_counter()
        try:
            status, answer, answered_id, retry_after = await self.send(doors, id_)
        except httpx.TransportError as error:
            status, answer, answered_id = f"{NO_ANSWER}: {type(error).__name__}", None, id_
            retry_after = False
        except TimeoutError:
            status, answer, answered_id = f"{NO_ANSWER}: none in time", None, id_
            retry_after = False
        seconds = perf_counter() - started
        return Outcome(status, _comparable(answer), answered_id == id_, retry_after, seconds)


def good_cases(maps: SampleMaps) -> list[Case]:
    """All photos over both doors, those of one instant as a rig, of a camera as a sequence."""
    cases = []
    for map_id, photos in maps.photos.items():
        for number, photo in enumerate(photos):
            name = f"{map_id} photo {number}"
            cases.append(_http_photo(name, map_id, photo))
            cases.append(_grpc_photo(name, map_id, photo))
        cases.append(
            _form_post(f"{map_id} photo in two maps", {"maps": ",".join(maps.photos)}, photos[0])
        )
        cases.append(_json_post(f"{map_id} rig", "/localize/rig", _rig_body(map_id, photos)))
        sequence = _sequence_body(map_id, photos)
        cases.append(_json_post(f"{map_id} sequence", "/localize/sequence", sequence))
    return cases


def bad_cases(maps: SampleMaps) -> list[Case]:
    """What cannot be localized, and what should not have been sent."""
    room, hall = maps.photos["room"][0], maps.photos["hall"][0]
    cut = replace(room, image=room.image[: len(room.image) // 3])
    text = replace(room, image=b"not a photo")
    other = replace(room, camera=Camera("PINHOLE", 640, 360, (500.0, 500.0, 320.0, 180.0)))
    bomb = replace(room, image=_png_of(60_000, 60_000))
    cases = []
    for post in (_http_photo, _grpc_photo):
        cases += [
            post("another place", "room", hall),
            post("cut photo", "room", cut),
            post("text", "room", text),
            post("camera of another size", "room", other),
            post("photo of 3.6 gigapixels", "room", bomb),
            post("unknown map", "kitchen", room),
            post("map id that is a path", "../room", room),
        ]
    return [
        *cases,
        _form_post("option", {"map": "room", "options": '{"top_k": 0}'}, room),
        _post("broken JSON", "/localize", b'{"map": "room", ', "application/json"),
        _post("deep JSON", "/localize", b"[" * 100_000, "application/json"),
        _post("other media type", "/localize", b"<xml/>", "application/xml"),
        _post("unknown path", "/nowhere", b"", "text/plain"),
        _json_post("rig without photos", "/localize/rig", {"map": "room", "images": []}),
    ]


def _comparable(answer: Any) -> str:
    return json.dumps(_without(answer), sort_keys=True)


def _without(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _without(v) for k, v in value.items() if k not in _OF_THE_REQUEST}
    if isinstance(value, list):
        return [_without(item) for item in value]
    return value


async def _answer(response: httpx.Response) -> tuple[str, Any, str, bool]:
    answer = response.json()
    code = answer.get("code", "") if isinstance(answer, dict) else ""
    status = f"{response.status_code} {code}".strip()
    headers = response.headers
    return status, answer, headers.get("x-request-id", ""), "retry-after" in headers


def _post(name: str, path: str, body: bytes, kind: str) -> Case:
    async def send(doors: Doors, id_: str) -> tuple[str, Any, str, bool]:
        headers = {"X-Request-Id": id_, "Content-Type": kind}
        return await _answer(await doors.http.post(path, content=body, headers=headers))

    return Case(f"http {name}", send)


def _json_post(name: str, path: str, body: object) -> Case:
    return _post(name, path, json.dumps(body).encode(), "application/json")


def _form_post(name: str, fields: dict[str, str], photo: Photo) -> Case:
    request = httpx.Request(
        "POST",
        "http://x",
        data={**fields, "camera": camera_text(photo.camera)},
        files={"image": photo.image},
    )
    return _post(name, "/localize", request.read(), request.headers["content-type"])


def _http_photo(name: str, map_ref: str, photo: Photo) -> Case:
    return _form_post(name, {"map": map_ref}, photo)


def _grpc_photo(name: str, map_ref: str, photo: Photo) -> Case:
    camera = WireCamera(
        model=photo.camera.model,
        width=photo.camera.width,
        height=photo.camera.height,
        params=photo.camera.params,
    )

    async def send(doors: Doors, id_: str) -> tuple[str, Any, str, bool]:
        request = LocalizeRequest(map=map_ref, image=photo.image, camera=camera, request_id=id_)
        try:
            answer = await doors.stub.Localize(request, timeout=_ANSWER_WITHIN_S)
        except grpc.aio.AioRpcError as error:
            return _refusal(error, id_)
        return (
            "OK",
            MessageToDict(answer, preserving_proto_field_name=True),
            answer.request_id,
            False,
        )

    return Case(f"grpc {name}", send)


def camera_text(camera: Camera) -> str:
    """A camera as a field of a form has it."""
    return ",".join(map(str, (camera.model, camera.width, camera.height, *camera.params)))


def _refusal(error: grpc.aio.AioRpcError, id_: str) -> tuple[str, Any, str, bool]:
    code = error.code().name
    trailing = cast(Iterable[tuple[str, str | bytes]], error.trailing_metadata() or ())
    details = dict(trailing).get("grpc-status-details-bin")
    if details is None:  # not from the service, but from the client's library
        return f"{NO_ANSWER}: {code}", None, id_, False
    assert isinstance(details, bytes)
    info = ErrorInfo()
    assert Status.FromString(details).details[0].Unpack(info)
    about = dict(info.metadata)
    answer = {"reason": info.reason, **about}
    return f"{code} {info.reason}", answer, about.get("request_id", ""), False


def _rig_body(map_id: str, photos: Sequence[Photo]) -> Mapping[str, object]:
    """The photos of the first instant, as one rig's."""
    pair = [photo for photo in photos if photo.timestamp == photos[0].timestamp]
    sensors = {
        photo.sensor: {
            "cam_from_rig": {
                "rotation_wxyz": photo.cam_from_rig.rotation_wxyz.tolist(),
                "translation": photo.cam_from_rig.translation.tolist(),
            },
            "camera": _camera_json(photo),
        }
        for photo in pair
    }
    images = [{"sensor": photo.sensor, "image": _base64(photo)} for photo in pair]
    return {"map": map_id, "rig": {"sensors": sensors}, "images": images}


def _sequence_body(map_id: str, photos: Sequence[Photo]) -> Mapping[str, object]:
    """The photos of the first camera, one instant each."""
    own = [photo for photo in photos if photo.sensor == photos[0].sensor]
    instants = [
        {
            "timestamp": photo.timestamp,
            "images": [{"image": _base64(photo), "camera": _camera_json(photo)}],
        }
        for photo in own
    ]
    return {"map": map_id, "instants": instants, "time_unit": "ms"}


def _camera_json(photo: Photo) -> dict[str, object]:
    camera = photo.camera
    return {
        "model": camera.model,
        "width": camera.width,
        "height": camera.height,
        "params": list(camera.params),
    }


def _base64(photo: Photo) -> str:
    return b64encode(photo.image).decode()


def _png_of(width: int, height: int) -> bytes:
    """A PNG that says that it is large, and is not."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        checksum = zlib.crc32(kind + data)
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", checksum)

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    data = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + data
