"""A localization service with canned answers, behind real HTTP and gRPC servers on loopback."""

from __future__ import annotations

import json
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent import futures
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import grpc
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
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from visloc.errors import InvalidInput, NotFound, Overloaded, TooLarge, VislocError, WeightsError
from visloc_api.v1 import localization_pb2 as pb2
from visloc_api.v1 import localization_pb2_grpc as pb2_grpc

VERSION = "1.2.3"
CAMERA = "SIMPLE_PINHOLE, 64, 48, 60, 32, 24"
POSE = {
    "cam_from_world": {
        "rotation_wxyz": [0.9298410554097046, 0.01755162593, 0.31931803130557, 0.1819987554486438],
        "translation": [0.24164110554685916, -0.0, 1e-17],
    },
    "position": [1.0, 0.1 + 0.2, -3.5],
    "orientation": [0.9298410554097046, -0.01755162593, -0.31931803130557, -0.1819987554486438],
    "covariance": [1e-9 * (i * 6 + j + 1) for i in range(6) for j in range(6)],
    "position_std": [0.004, 0.005, 1 / 3],
    "orientation_std_deg": [0.1, 0.2, 0.3],
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
    ``slow``: waits; ``gone``, ``weights``, ``preset``: errors of all photos; JSON: the pose to
    answer; else: ``POSE``.
    """

    version: str = "v1"
    seen: list[dict[str, Any]] = field(default_factory=list)
    is_ready: bool = True
    slow_s: float = 0.3
    busy: Counter[bytes] = field(default_factory=Counter)
    local_features: str = "xfeat"
    global_features: tuple[str, ...] = ("densevlad", "localvlad")

    def localize(
        self, image: bytes, asked: dict[str, Any], features: dict[str, Any] | None = None
    ) -> dict[str, Any]:
        self.seen.append({"image": image} if features is None else {"features": features})
        self.seen[-1] |= asked
        self.map_info(asked["map"])
        match image.partition(b" ")[0]:
            case b"broken":
                raise InvalidInput(
                    "image.undecodable", "not a photo", field="image", expected="JPEG", got="text"
                )
            case b"huge":
                raise TooLarge("image.too_large", "too many bytes", field="image")
            case b"crash":
                raise VislocError("server.internal", "the server made a mistake")
            case b"gone":
                raise NotFound("map.unknown", "no such map", field="map", got=asked["map"])
            case b"weights":
                raise WeightsError("weights.missing", "the network has no weights")
            case b"preset":
                raise InvalidInput("options.preset", "unknown preset", field="options.preset")
            case b"slow":
                time.sleep(self.slow_s)
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
            "orientation": {"exif": 6, "read_as": "stored"},
            "map": {"id": "room", "version": self.version},
            "seconds": {"features": 0.25, "pose": 0.0} if refusal is None else {"features": 0.75},
        }

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
        }


@pytest.fixture(autouse=True)
def service(_servers: tuple[CannedService, str, str]) -> CannedService:
    """The canned service, as new."""
    canned = _servers[0]
    canned.__init__()  # type: ignore[misc]
    return canned


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
            assert set(form) <= {"image", "features", "map", "camera", "options"}
            assert ("image" in form) != ("features" in form)
            file = form["image" if "image" in form else "features"]
            assert not isinstance(file, str)
            content = await file.read()
            asked = {
                "map": form["map"],
                "camera": json.loads(str(form["camera"])) if "camera" in form else None,
                "options": json.loads(str(form["options"])),
                "request_id": request.headers.get("x-request-id"),
            }
            if "image" in form:
                return await run_in_threadpool(localize, content, asked)
            return await run_in_threadpool(localize, b"", asked, json.loads(content))

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
        status = STATUSES[type(error)][0]
        body = {
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
        return JSONResponse(body, status, media_type="application/problem+json")

    return Starlette(
        routes=[
            Route("/localize", post, methods=["POST"]),
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
        asked = {
            "map": request.map,
            "camera": camera,
            "options": options,
            "request_id": request.request_id or None,
        }
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

    def ListMaps(self, request: Any, context: Any) -> Any:  # noqa: ARG002, N802
        return self._answer(
            context, lambda: {"maps": [self._canned.map_info("room")]}, pb2.ListMapsResponse()
        )

    def GetMap(self, request: Any, context: Any) -> Any:  # noqa: N802
        return self._answer(context, lambda: self._canned.map_info(request.map), pb2.MapInfo())

    def _answer(self, context: Any, make: Any, message: Any) -> Any:
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


def _without_nulls(answer: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in answer.items() if value is not None}


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
        numbers = [*pose["rotation_wxyz"], *pose["translation"]]  # type: ignore[index, call-overload]
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
