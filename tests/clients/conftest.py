"""A localization service with canned answers, behind real HTTP and gRPC servers on loopback."""

from __future__ import annotations

import base64
import contextlib
import json
import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent import futures
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
import uvicorn
from google.protobuf.any_pb2 import Any as AnyMessage
from google.protobuf.json_format import MessageToDict, ParseDict
from google.rpc.error_details_pb2 import ErrorInfo
from google.rpc.status_pb2 import Status
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from visloc.errors import InvalidInput, NotFound, Overloaded, TooLarge, VislocError, WeightsError
from visloc.geometry import Pose
from visloc_api.v1 import localization_pb2 as pb2
from visloc_api.v1 import localization_pb2_grpc as pb2_grpc

VERSION = "1.2.3"
CAMERA = "SIMPLE_PINHOLE, 64, 48, 60, 32, 24"
# The places of a photo that begins with "refuse both".
TWO_DOORS: list[dict[str, Any]] = [
    {
        "map": {"id": "floors", "version": "v2"},
        "tile": "room@v1",
        "position": [1.0, 0.25, -3.5],
        "orientation": [1.0, 0.0, 0.0, 0.0],
        "inliers": 60,
        "image": "door [1].jpg",
        "preference": 0.5,
    },
    {
        "map": {"id": "shed", "version": "v1"},
        "tile": None,
        "position": [9.0, 0.25, -3.5],
        "orientation": [0.0, 1.0, 0.0, 0.0],
        "inliers": 40,
        "image": None,
        "preference": None,
    },
]
POSE: dict[str, Any] = {
    "cam_from_world": {
        "rotation_wxyz": [0.9298410554097046, 0.01755162593, 0.31931803130557, 0.1819987554486438],
        "translation": [0.24164110554685916, -0.0, 1e-17],
    },
    "position": [1.0, 0.1 + 0.2, -3.5],
    "orientation": [0.9298410554097046, -0.01755162593, -0.31931803130557, -0.1819987554486438],
    "covariance": [1e-9 * (1 / (i + j + 1) + 7 * (i == j)) for i in range(6) for j in range(6)],
    "position_std": [0.004, 0.005, 1 / 3],
    "orientation_std_deg": [0.1, 0.2, 0.3],
    "photo_covariance": [1e-10 / (i + j + 1) for i in range(6) for j in range(6)],
    "uncertainty": "whole",
    "probability": 1 / 3,
    "metric": True,
}
GEOPOSE: dict[str, Any] = {
    "position": {"lat": 48.25, "lon": -122.1, "h": 1 / 3},
    "quaternion": {"x": 0.0, "y": -0.1, "z": 1 / 7, "w": 0.98},
}
DEBUG: dict[str, Any] = {
    "keypoints": [1.5, 2.0, 3.0, 0.1 + 0.2],
    "points": [1.0, 2.0, 3.0, 1e6, -5e6, 1 / 3],
    "inliers": [True, False],
    "overlay": base64.b64encode(bytes(range(256))).decode(),
}
# The rig that the canned map knows: the right camera is half a metre to the right of the left one.
STEREO = {
    "left": Pose.identity(),
    "right": Pose.from_quaternion([1.0, 0.0, 0.0, 0.0], [-0.5, 0.0, 0.0]),
}
STATUSES = {
    InvalidInput: (422, grpc.StatusCode.INVALID_ARGUMENT),
    TooLarge: (413, grpc.StatusCode.RESOURCE_EXHAUSTED),
    WeightsError: (409, grpc.StatusCode.FAILED_PRECONDITION),
    NotFound: (404, grpc.StatusCode.NOT_FOUND),
    Overloaded: (429, grpc.StatusCode.RESOURCE_EXHAUSTED),
    VislocError: (500, grpc.StatusCode.INTERNAL),
}


@dataclass
class CannedService:
    """What a photo's bytes begin with decides what becomes of it; features give ``POSE``.

    ``refuse``: not localized; ``broken``, ``huge``, ``crash``: errors; ``busy``: overloaded twice;
    ``slow``: waits ``slow_s``, or until ``hurry``; ``gone``, ``weights``, ``preset``: errors of all
    photos; JSON: the pose to answer; else: ``POSE``.
    """

    version: str = "v1"
    seen: list[dict[str, Any]] = field(default_factory=list)
    is_ready: bool = True
    slow_s: float = 0.3
    hurry: threading.Event = field(default_factory=threading.Event)
    busy: Counter[bytes] = field(default_factory=Counter)
    local_features: str = "xfeat"
    global_features: tuple[str, ...] = ("densevlad", "localvlad")
    fails_at_the_end: bool = False
    draws: bool = True

    def localize(
        self, image: bytes, asked: dict[str, Any], features: dict[str, Any] | None = None
    ) -> dict[str, Any]:
        self.seen.append({"image": image} if features is None else {"features": features})
        self.seen[-1] |= asked
        self.map_info(asked["map"] or asked["maps"][0])
        match image.partition(b" ")[0]:
            case b"broken":
                raise InvalidInput(
                    "image.undecodable", "not a photo", field="image", expected="JPEG", got="text"
                )
            case b"huge":
                raise TooLarge("image.too_large", "too many bytes", field="image")
            case b"crash":
                raise VislocError("server.internal", "internal error")
            case b"gone":
                raise NotFound("map.unknown", "no such map", field="map", got=asked["map"])
            case b"weights":
                raise WeightsError("weights.missing", "the network has no weights")
            case b"preset":
                raise InvalidInput("options.preset", "unknown preset", field="options.preset")
            case b"slow":
                self.hurry.wait(self.slow_s)
            case b"busy":
                self.busy[image] += 1
                if self.busy[image] <= 2:
                    raise Overloaded("server.busy", "too many requests are waiting")
        pose: dict[str, Any] | None = POSE
        if image.startswith(b"{"):
            pose = POSE | {"cam_from_world": json.loads(image)}
        refusal = None
        if image.startswith(b"refuse"):
            pose = None
            refusal = {"stage": "matching", "reason": "too_few_matches", "message": "3 [matches]"}
            refusal |= {"candidates": TWO_DOORS if image.startswith(b"refuse both") else []}
        return {
            "request_id": asked["request_id"] or "made-up",
            "status": "localized" if refusal is None else "not_localized",
            "pose": pose,
            "refusal": refusal,
            "keypoints": 4096,
            "correspondences": 700 if refusal is None else 3,
            "inliers": 311 if refusal is None else 0,
            "inlier_ratio": 311 / 700 if refusal is None else 0.0,
            "retrieved": [
                {"image": "seq/1.jpg", "score": 0.75, "similarities": {"densevlad": 1 / 7}}
            ],
            "camera": (
                asked["camera"]
                or {"model": "SIMPLE_PINHOLE", "width": 64, "height": 48, "params": [76.8, 32, 24]}
            )
            | {"source": "given" if asked["camera"] else "guess"},
            "orientation": {"exif": 6, "read_as": "stored", "turned": 0},
            "map": {"id": "room", "version": self.version},
            "seconds": {"features": 0.25, "pose": 0.0} if refusal is None else {"features": 0.75},
            "geopose": None if pose is None else GEOPOSE,
            "geopose_ypr": None,
            "debug": DEBUG if asked.get("debug") and self.draws else None,
            "tile": None,
            "coarse": None,
        }

    def localize_instant(
        self, asked: dict[str, Any], images: list[dict[str, Any]], timestamp: int | None
    ) -> dict[str, Any]:
        """Take the pose of the first photo that is one in JSON; see ``localize`` for others.

        A rig whose first photo is ``filled`` is between two others; a photo that is ``blank`` has
        no inlier.
        """
        self.seen.append(asked | {"images": images, "timestamp": timestamp})
        self.map_info(asked["map"])
        cam_from_rig = _calibration(asked["rig"])
        answers, rig_from_world = [], None
        for image in images:
            content = image["image"]
            if image["sensor"] not in cam_from_rig:
                raise InvalidInput(
                    "rig.sensor", "no such camera", field="sensor", got=image["sensor"]
                )
            error = None
            if content.startswith(b"broken"):
                error = {"kind": "InvalidInput", "code": "image.undecodable", "message": "no photo"}
            elif content.startswith(b"crash"):
                raise VislocError("server.internal", "internal error")
            elif content.startswith(b"busy"):
                self.busy[content] += 1
                if self.busy[content] <= 2:
                    raise Overloaded("server.busy", "too many requests are waiting")
            elif content.startswith(b"slow"):
                self.hurry.wait(self.slow_s)
            elif content.startswith((b"{", b"photo", b"filled")) and rig_from_world is None:
                pose = json.loads(content) if content.startswith(b"{") else POSE["cam_from_world"]
                cam_from_world = Pose.from_quaternion(**pose)
                rig_from_world = cam_from_rig[image["sensor"]].inverse() @ cam_from_world
            answers.append(
                {
                    "sensor": image["sensor"],
                    "error": error,
                    "cam_from_world": None,
                    "keypoints": 0 if error else 4096,
                    "correspondences": 0 if error else 700,
                    "inliers": 0,
                    "retrieved": [],
                    "camera": None
                    if error
                    else {"model": "SIMPLE_PINHOLE", "width": 64, "height": 48}
                    | {"params": [60.0, 32.0, 24.0], "source": "given"},
                    "orientation": None if error else {"exif": 1, "read_as": "stored", "turned": 0},
                }
            )
        is_filled = bool(images) and images[0]["image"].startswith(b"filled")
        if rig_from_world is not None:
            for answer in answers:
                answer["cam_from_world"] = _transform(
                    cam_from_rig[answer["sensor"]] @ rig_from_world
                )
                if answer["error"] is None:
                    answer["inliers"] = 311
            for answer, image in zip(answers, images, strict=True):
                if image["image"].startswith(b"blank"):
                    answer["inliers"] = 0
        refusal = {"stage": "matching", "reason": "too_few_matches", "message": "3 [matches]"}
        refusal |= {"candidates": []}
        num_inliers = sum(answer["inliers"] for answer in answers)
        num_correspondences = sum(answer["correspondences"] for answer in answers)
        return {
            "request_id": asked["request_id"] or "made-up",
            "timestamp": timestamp,
            "status": "not_localized"
            if rig_from_world is None
            else "filled"
            if is_filled
            else "localized",
            "source": None
            if rig_from_world is None
            else "interpolated"
            if is_filled
            else "estimated",
            "pose": None
            if rig_from_world is None
            else {
                "rig_from_world": _transform(rig_from_world),
                "position": rig_from_world.center.tolist(),
                "orientation": rig_from_world.inverse().rotation_wxyz.tolist(),
                "covariance": (np.eye(6) * (4e-4 if is_filled else 1e-4)).ravel().tolist(),
                "position_std": [0.01, 0.01, 0.01],
                "orientation_std_deg": [0.57, 0.57, 0.57],
                "photo_covariance": [] if is_filled else (np.eye(6) * 2.5e-5).ravel().tolist(),
                "uncertainty": "whole",
                "probability": None if is_filled else 0.75,
                "metric": True,
            },
            "refusal": refusal if rig_from_world is None or is_filled else None,
            "images": answers,
            "correspondences": num_correspondences,
            "inliers": num_inliers,
            "inlier_ratio": num_inliers / max(num_correspondences, 1),
            "map": {"id": "room", "version": self.version},
            "seconds": {"features": 0.5, "pose": 0.25},
            "geopose": None,
            "geopose_ypr": None,
            "tile": None,
        }

    def finish_sequence(self, num_instants: int) -> None:
        if num_instants == 0:
            raise InvalidInput("sequence.empty", "there is no instant", field="instants")
        if self.fails_at_the_end:
            raise VislocError("server.internal", "internal error")

    def map_info(self, ref: str) -> dict[str, Any]:
        if ref not in ("room", f"room@{self.version}"):
            raise NotFound(
                "map.unknown", "no such map", field="map", expected="one of: room", got=ref
            )
        return {
            "id": "room",
            "version": self.version,
            "created": "2026-01-02T03:04:05Z",
            "metric": True,
            "method": "rgbd",
            "local_features": self.local_features,
            "global_features": list(self.global_features),
            "images": 300,
            "landmarks": 0,
            "observations": 5,
            "extent": {"min": [-1.5, 0.0, 0.0], "max": [1.0, 2.0, 0.1]},
            "size_bytes": 2**53 + 1,
            "down": [0.0, 1.0, 0.0],
            "rigs": [{"id": "stereo", "sensors": list(STEREO)}],
            "anchor": {
                "kind": "gnss",
                "images": 300,
                "rms": 1 / 3,
                "geodetic": {
                    "latitude_deg": 48.25,
                    "longitude_deg": -122.1,
                    "altitude_m": 0.0,
                    "scale": 1.0,
                    "rotation_wxyz": [1.0, 0.0, 0.0, 0.0],
                    "translation": [0.0, 0.0, 0.0],
                },
            },
            "place": {"latitude": 48.25, "longitude": -122.1, "radius": 12.5},
            "current": True,
            "versions": [{"version": self.version, "current": True}],
            "content_hash": "ab" * 32,
            "fusion": "mean",
            "fusion_weights": {"densevlad": 1 / 3},
            "kind": "map",
            "num_tiles": None,
            "tiles": [],
        }


@pytest.fixture(autouse=True)
def service(_servers: tuple[CannedService, str, str]) -> Iterator[CannedService]:
    """The canned service, as new."""
    canned = _servers[0]
    canned.__init__()  # type: ignore[misc]
    yield canned
    canned.hurry.set()


@pytest.fixture
def http_url(_servers: tuple[CannedService, str, str]) -> str:
    return _servers[1]


@pytest.fixture
def grpc_url(_servers: tuple[CannedService, str, str]) -> str:
    return _servers[2]


@pytest.fixture(params=["http", "grpc"])
def url(request: pytest.FixtureRequest) -> str:
    """The address of the canned service: the test runs over HTTP, then over gRPC."""
    address: str = request.getfixturevalue(f"{request.param}_url")
    return address


@pytest.fixture(scope="session")
def _servers() -> Iterator[tuple[CannedService, str, str]]:
    canned = CannedService()
    http_server = uvicorn.Server(
        uvicorn.Config(_http_app(canned), port=0, log_level="critical", lifespan="off")
    )
    thread = threading.Thread(target=http_server.run)
    thread.start()
    while not http_server.started:
        time.sleep(0.01)
    http_port = http_server.servers[0].sockets[0].getsockname()[1]
    grpc_server = grpc.server(futures.ThreadPoolExecutor(8))
    pb2_grpc.add_LocalizationServicer_to_server(_Servicer(canned), grpc_server)
    health_pb2_grpc.add_HealthServicer_to_server(_Health(canned), grpc_server)
    grpc_port = grpc_server.add_insecure_port("127.0.0.1:0")
    grpc_server.start()
    yield canned, f"http://127.0.0.1:{http_port}", f"grpc://127.0.0.1:{grpc_port}"
    grpc_server.stop(None).wait()
    http_server.should_exit = True
    thread.join()


def _http_app(canned: CannedService) -> Starlette:
    def localize(image: bytes, *rest: Any) -> Response:
        return JSONResponse(canned.localize(image, *rest))

    async def post(request: Request) -> Response:
        async with request.form() as form:
            known = {"image", "features", "map", "maps", "camera", "options", "priors", "debug"}
            assert set(form) <= known
            assert ("map" in form) != ("maps" in form)
            assert ("image" in form) != ("features" in form)
            file = form["image" if "image" in form else "features"]
            assert not isinstance(file, str)
            content = await file.read()

            def read(name: str) -> Any:
                return json.loads(str(form[name])) if name in form else None

            asked = {
                "map": form.get("map"),
                "camera": read("camera"),
                "options": read("options") or {},
                "request_id": request.headers.get("x-request-id"),
                **{name: read(name) for name in ("maps", "priors", "debug") if name in form},
            }
            if "image" in form:
                return await run_in_threadpool(localize, content, asked)
            return await run_in_threadpool(localize, b"", asked, json.loads(content))

    async def read_batch(request: Request) -> tuple[dict[str, Any], dict[str, bytes]]:
        async with request.form() as form:
            asked = json.loads(str(form["request"]))
            files = {
                name: await part.read()
                for name, part in form.items()
                if name != "request" and not isinstance(part, str)
            }
            assert len(files) == len(form) - 1
        return asked, files

    def images_of(said: dict[str, Any], files: dict[str, bytes]) -> list[dict[str, Any]]:
        return [
            {name: value for name, value in image.items() if name != "part"}
            | ({"image": files[image["part"]]} if "part" in image else {"image": b"photo"})
            for image in said["images"]
        ]

    def shared(asked: dict[str, Any], request: Request) -> dict[str, Any]:
        common = {"map": None, "options": {}, "rig": None} | asked
        common["request_id"] = request.headers.get("x-request-id")
        return {name: v for name, v in common.items() if name not in ("images", "instants")}

    async def post_rig(request: Request) -> Response:
        asked, files = await read_batch(request)
        images = images_of(asked, files)
        timestamp = images[0].get("timestamp") if images else None
        return JSONResponse(
            await run_in_threadpool(
                canned.localize_instant, shared(asked, request), images, timestamp
            )
        )

    async def post_sequence(request: Request) -> Response:
        assert request.headers["accept"] == "application/x-ndjson"
        asked, files = await read_batch(request)
        common = shared(asked, request)

        async def lines() -> Any:
            for instant in asked["instants"]:
                extra = {k: instant[k] for k in ("odometry", "priors") if k in instant}
                try:
                    answer = await run_in_threadpool(
                        canned.localize_instant,
                        common | extra,
                        images_of(instant, files),
                        instant["timestamp"],
                    )
                except VislocError as error:
                    yield json.dumps({"problem": problem_of(error)}).encode() + b"\n"
                    return
                text = json.dumps(answer, ensure_ascii=False).encode() + b"\n"
                yield text[:100]  # lines come in pieces
                yield text[100:]

        canned.map_info(asked["map"])
        canned.finish_sequence(len(asked["instants"]))
        return StreamingResponse(lines(), media_type="application/x-ndjson")

    async def maps(_: Request) -> Response:
        return JSONResponse({"maps": [canned.map_info("room")]})

    async def get_map(request: Request) -> Response:
        return JSONResponse(canned.map_info(request.path_params["id"]))

    async def healthz(_: Request) -> Response:
        return JSONResponse({"status": "ok", "version": VERSION})

    async def readyz(_: Request) -> Response:
        return JSONResponse({"ready": canned.is_ready}, 200 if canned.is_ready else 503)

    async def problem(_: Request, error: Exception) -> Response:
        assert isinstance(error, VislocError)
        body = problem_of(error)
        return JSONResponse(body, body["status"], media_type="application/problem+json")

    def problem_of(error: VislocError) -> dict[str, Any]:
        status = STATUSES[type(error)][0]
        return {
            "type": "about:blank",
            "title": "Problem",
            "status": status,
            "detail": error.message,
            "code": error.code,
            "field": error.field,
            "expected": error.expected,
            "got": error.got,
            "kind": type(error).__name__,
            "request_id": "made-up",
        }

    return Starlette(
        routes=[
            Route("/localize", post, methods=["POST"]),
            Route("/localize/rig", post_rig, methods=["POST"]),
            Route("/localize/sequence", post_sequence, methods=["POST"]),
            Route("/maps", maps),
            Route("/maps/{id}", get_map),
            Route("/healthz", healthz),
            Route("/readyz", readyz),
        ],
        exception_handlers={VislocError: problem},
    )


class _Servicer(pb2_grpc.LocalizationServicer):
    def __init__(self, canned: CannedService) -> None:
        self._canned = canned

    def Localize(self, request: Any, context: Any) -> Any:  # noqa: N802
        camera = MessageToDict(request.camera) if request.HasField("camera") else None
        options = MessageToDict(request.options, preserving_proto_field_name=True)
        asked = _asked(request) | {"camera": camera, "options": options}
        if request.HasField("debug"):
            asked["debug"] = request.debug
        features = None
        if request.WhichOneof("query") == "features":
            # protobuf writes bytes in base64, and no empty maps.
            features = {"global_descriptors": {}} | MessageToDict(
                request.features, preserving_proto_field_name=True
            )
        return self._answer(
            context,
            lambda: _without_nulls(self._canned.localize(request.image, asked, features)),
            pb2.LocalizeResponse(),
        )

    def LocalizeRig(self, request: Any, context: Any) -> Any:  # noqa: N802
        images = [_image_of(image) for image in request.images]
        timestamp = images[0].get("timestamp") if images else None
        return self._answer(
            context,
            lambda: _without_nulls(
                self._canned.localize_instant(_asked_of_rig(request), images, timestamp)
            ),
            pb2.InstantAnswer(),
        )

    def LocalizeSequence(self, requests: Any, context: Any) -> Any:  # noqa: N802
        asked: dict[str, Any] = {}
        num_instants = 0
        for request in requests:
            if request.WhichOneof("message") == "start":
                asked = _asked_of_rig(request.start)
                for name in ("time_unit", "max_gap_s"):
                    if (
                        request.start.HasField(name)
                        if name == "max_gap_s"
                        else request.start.time_unit
                    ):
                        asked[name] = getattr(request.start, name)
                continue
            instant = request.instant
            num_instants += 1
            extra = {
                name: MessageToDict(getattr(instant, name), preserving_proto_field_name=True)
                for name in ("odometry", "priors")
                if instant.HasField(name)
            }
            yield self._answer(
                context,
                lambda instant=instant, asked=asked | extra: _without_nulls(
                    self._canned.localize_instant(
                        asked,
                        [_image_of(image) for image in instant.images],
                        instant.timestamp,
                    )
                ),
                pb2.InstantAnswer(),
            )

        def finish() -> Any:
            self._canned.finish_sequence(num_instants)
            return {}

        self._answer(context, finish, pb2.InstantAnswer())

    def ListMaps(self, request: Any, context: Any) -> Any:  # noqa: ARG002, N802
        return self._answer(
            context, lambda: {"maps": [self._canned.map_info("room")]}, pb2.ListMapsResponse()
        )

    def GetMap(self, request: Any, context: Any) -> Any:  # noqa: N802
        return self._answer(context, lambda: self._canned.map_info(request.map), pb2.MapInfo())

    def _answer(self, context: Any, make: Any, message: Any) -> Any:
        with contextlib.suppress(ValueError):  # once in a stream
            context.send_initial_metadata((("visloc-version", VERSION),))
        try:
            return ParseDict(make(), message)
        except VislocError as error:
            parts = {
                "kind": type(error).__name__,
                "message": error.message,
                "field": error.field,
                "expected": error.expected,
                "got": error.got,
            }
            info = ErrorInfo(reason=error.code, domain="visloc")
            info.metadata.update({name: value for name, value in parts.items() if value})
            detail = AnyMessage()
            detail.Pack(info)
            code = STATUSES[type(error)][1]
            status = Status(code=code.value[0], message=str(error), details=[detail])
            context.set_trailing_metadata(
                (("grpc-status-details-bin", status.SerializeToString()),)
            )
            context.abort(code, str(error))


class _Health(health.HealthServicer):
    def __init__(self, canned: CannedService) -> None:
        super().__init__()
        self._canned = canned

    def Check(self, request: Any, context: Any) -> Any:  # noqa: ARG002, N802
        response = health_pb2.HealthCheckResponse
        return response(status=response.SERVING if self._canned.is_ready else response.NOT_SERVING)


def _asked(request: Any) -> dict[str, Any]:
    asked = {"map": request.map or None, "request_id": request.request_id or None}
    if request.maps:
        asked["maps"] = list(request.maps)
    if request.HasField("priors"):
        asked["priors"] = MessageToDict(request.priors, preserving_proto_field_name=True)
    return asked


def _asked_of_rig(request: Any) -> dict[str, Any]:
    rig: Any = None
    match request.WhichOneof("rig"):
        case "rig_id":
            rig = request.rig_id
        case "calibration":
            rig = MessageToDict(request.calibration, preserving_proto_field_name=True)
    options = MessageToDict(request.options, preserving_proto_field_name=True)
    return _asked(request) | {"rig": rig, "options": options}


def _image_of(image: Any) -> dict[str, Any]:
    said: dict[str, Any] = {"sensor": image.sensor}
    if image.WhichOneof("query") == "features":
        features = MessageToDict(image.features, preserving_proto_field_name=True)
        said |= {"features": {"global_descriptors": {}} | features, "image": b"photo"}
    else:
        said["image"] = image.image
    if image.HasField("camera"):
        said["camera"] = MessageToDict(image.camera)
    if image.HasField("timestamp"):
        said["timestamp"] = image.timestamp
    return said


def _calibration(rig: Any) -> dict[str, Pose]:
    if rig is None:
        return {"camera": Pose.identity()}
    if isinstance(rig, str):
        if rig != "stereo":
            raise NotFound("rig.unknown", "no such rig", field="rig", got=rig)
        return STEREO
    return {
        name: Pose.from_quaternion(**sensor["cam_from_rig"])
        for name, sensor in rig["sensors"].items()
    }


def _transform(pose: Pose) -> dict[str, Any]:
    return {
        "rotation_wxyz": pose.rotation_wxyz.tolist(),
        "translation": pose.translation.tolist(),
    }


def _without_nulls(answer: Any) -> Any:
    if isinstance(answer, list):
        return [_without_nulls(value) for value in answer]
    if not isinstance(answer, dict):
        return answer
    return {name: _without_nulls(value) for name, value in answer.items() if value is not None}


@pytest.fixture
def make_dataset(tmp_path: Path) -> Callable[..., Path]:
    """Write a kapture dataset of given photos; the true poses are those of ``POSE``."""

    def make(photos: dict[str, bytes], *, camera: str = CAMERA, truth: bool = True) -> Path:
        sensors = tmp_path / "dataset" / "sensors"
        data = sensors / "records_data"
        data.mkdir(parents=True, exist_ok=True)
        files: dict[str, list[str]] = {
            "sensors.txt": [f"cam, , camera, {camera}"],
            "records_camera.txt": [],
            "trajectories.txt": [],
        }
        pose = POSE["cam_from_world"]
        numbers = [*pose["rotation_wxyz"], *pose["translation"]]
        for timestamp, (name, content) in enumerate(photos.items()):
            (data / name).parent.mkdir(parents=True, exist_ok=True)
            (data / name).write_bytes(content)
            files["records_camera.txt"].append(f"{timestamp}, cam, {name}")
            if truth:
                row = ", ".join(map(repr, numbers))
                files["trajectories.txt"].append(f"{timestamp}, cam, {row}")
        for name, rows in files.items():
            text = "\n".join(["# kapture format: 1.1", *rows]) + "\n"
            (sensors / name).write_text(text, encoding="utf-8")
        return sensors.parent

    return make


@pytest.fixture
def make_rig_dataset(tmp_path: Path) -> Callable[..., Path]:
    """Write a kapture dataset of a moving ``STEREO`` rig.

    ``photos`` are by (timestamp, sensor); None is a photo that localizes at its true pose, which
    is that of ``rig_at(timestamp)``. All true poses are in trajectories.txt.
    """

    def make(
        photos: dict[tuple[int, str], bytes | None],
        *,
        rigs: str = "rig, left, 1, 0, 0, 0, 0, 0, 0\nrig, right, 1, 0, 0, 0, -0.5, 0, 0\n",
    ) -> Path:
        sensors = tmp_path / "rig dataset" / "sensors"
        (sensors / "records_data").mkdir(parents=True)
        known = dict.fromkeys(sensor for _, sensor in photos)
        header = "# kapture format: 1.1\n"
        (sensors / "sensors.txt").write_text(
            header + "".join(f"{sensor}, , camera, {CAMERA}\n" for sensor in known)
        )
        if rigs:
            (sensors / "rigs.txt").write_text(header + rigs)
        records, trajectories = header, header
        for (timestamp, sensor), content in photos.items():
            name = f"{sensor}-{timestamp}.jpg"
            pose = STEREO.get(sensor, Pose.identity()) @ rig_at(timestamp)
            photo = json.dumps(_transform(pose)).encode() if content is None else content
            (sensors / "records_data" / name).write_bytes(photo)
            records += f"{timestamp}, {sensor}, {name}\n"
            numbers = [*pose.rotation_wxyz, *pose.translation]
            trajectories += f"{timestamp}, {sensor}, {', '.join(map(repr, map(float, numbers)))}\n"
        (sensors / "records_camera.txt").write_text(records)
        (sensors / "trajectories.txt").write_text(trajectories)
        return sensors.parent

    return make


def rig_at(timestamp: int) -> Pose:
    """``rig_from_world``, in milliseconds, of a rig at 10 m/s along x that turns 10 degrees/s."""
    timestamp %= 100_000  # near the world's origin, whenever
    angle = math.radians(0.01 * timestamp)
    rotation = Pose.from_quaternion([math.cos(angle / 2), 0, math.sin(angle / 2), 0], [0, 0, 0])
    center = np.array([0.01 * timestamp, 0.0, 2.0])
    return Pose(rotation.rotation, -rotation.rotation @ center)
