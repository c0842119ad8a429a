from __future__ import annotations

import asyncio
import logging
import struct
import threading
import time
from typing import Any, NoReturn

import grpc
import pytest
from google.protobuf.json_format import MessageToDict
from google.rpc.error_details_pb2 import ErrorInfo
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc
from grpc_status import rpc_status

import visloc
from clients.transport.messages import plain
from service.grpc.server import SERVICE_NAMES
from service.telemetry.metrics import Metrics, ServiceState
from service.values import RigJob
from visloc_api.v1 import localization_pb2 as pb2


def request_for(query: Any, **fields: Any) -> pb2.LocalizeRequest:
    camera = query.camera
    return pb2.LocalizeRequest(
        **{
            "map": "room",
            "image": query.image,
            "camera": pb2.Camera(
                model=camera.model,
                width=camera.width,
                height=camera.height,
                params=camera.params,
            ),
        }
        | fields
    )


def refused(
    doors: Any, request: pb2.LocalizeRequest, status: grpc.StatusCode, code: str
) -> ErrorInfo:
    with pytest.raises(grpc.RpcError) as caught:
        doors.stub.Localize(request)
    return info_of(caught.value, status, code)


def info_of(call: Any, status: grpc.StatusCode, code: str) -> ErrorInfo:
    info = ErrorInfo()
    details = rpc_status.from_call(call)
    assert details is not None
    assert details.details[0].Unpack(info)
    assert (call.code(), info.reason, info.domain) == (status, code, "visloc")
    return info


def bits(value: object) -> object:
    """Floats by their bits, so that equal means equal; what gRPC leaves out is left out."""
    if isinstance(value, float):
        return struct.pack("<d", value)
    if isinstance(value, dict):
        return {name: bits(inner) for name, inner in value.items() if inner is not None}
    return [bits(inner) for inner in value] if isinstance(value, list) else value


def as_json(message: Any) -> dict[str, Any]:
    return MessageToDict(
        message, preserving_proto_field_name=True, always_print_fields_with_no_presence=True
    )


def test_both_doors_give_the_same_answer_bit_for_bit(doors: Any, query: Any) -> None:
    options = {"top_k": 4, "seed": 5, "min_inlier_ratio": 0.0, "preset": "config2"}
    over_grpc = as_json(
        doors.stub.Localize(request_for(query, options=pb2.LocalizeOptions(**options)))
    )
    camera = query.camera
    over_http = doors.http.post(
        "/localize",
        data={
            "map": "room",
            "camera": ",".join(
                map(str, (camera.model, camera.width, camera.height, *camera.params))
            ),
            "options": str(options).replace("'", '"'),
        },
        files={"image": ("q.jpg", query.image)},
    ).json()

    assert over_http["status"] == "localized"
    assert over_http.pop("seconds").keys() == over_grpc.pop("seconds").keys()
    assert over_http.pop("request_id") != over_grpc.pop("request_id")
    assert bits(over_http) == bits(over_grpc)


def test_a_refusal_has_no_pose(doors: Any, query: Any) -> None:
    answer = doors.stub.Localize(
        request_for(query, options=pb2.LocalizeOptions(min_inliers=1_000_000))
    )

    assert answer.status == "not_localized"
    assert not answer.HasField("pose")
    assert answer.refusal.reason == "too_few_matches"


def test_a_request_without_a_camera_is_answered_with_where_the_intrinsics_come_from(
    doors: Any, query: Any
) -> None:
    answer = doors.stub.Localize(pb2.LocalizeRequest(map="room", image=query.image))

    assert answer.camera.source == "map"


def test_a_request_id_comes_back_and_one_is_made_when_it_is_missing(doors: Any, query: Any) -> None:
    assert doors.stub.Localize(request_for(query, request_id="job-1")).request_id == "job-1"
    assert len(doors.stub.Localize(request_for(query)).request_id) == 32


def test_every_answer_carries_the_servers_version(doors: Any) -> None:
    _, call = doors.stub.ListMaps.with_call(pb2.ListMapsRequest())

    assert dict(call.initial_metadata())["visloc-version"] == visloc.__version__


@pytest.mark.parametrize(
    ("fields", "status", "code", "field"),
    [
        ({"image": b"hello"}, "INVALID_ARGUMENT", "image.format", "image"),
        ({"image": b""}, "INVALID_ARGUMENT", "image.empty", "image"),
        ({"image": b"\xff\xd8\xff" * 100}, "INVALID_ARGUMENT", "image.undecodable", "image"),
        ({"image": bytes(200_001)}, "RESOURCE_EXHAUSTED", "image.too_large", "image"),
        ({"map": "hall"}, "NOT_FOUND", "map.unknown", "map"),
        ({"map": ""}, "INVALID_ARGUMENT", "map.id", "map"),
        ({"camera": pb2.Camera()}, "INVALID_ARGUMENT", "camera.model", "camera.model"),
        (
            {"camera": pb2.Camera(model="PINHOLE", width=4, height=4, params=[1, 1, 2])},
            "INVALID_ARGUMENT",
            "camera.param_count",
            "camera.params",
        ),
        (
            {
                "camera": pb2.Camera(
                    model="SIMPLE_PINHOLE", width=4, height=4, params=[float("nan"), 2, 2]
                )
            },
            "INVALID_ARGUMENT",
            "camera.param_value",
            "camera.params",
        ),
        (
            {"camera": pb2.Camera(model="SIMPLE_PINHOLE", width=4, height=9, params=[4, 2, 2])},
            "INVALID_ARGUMENT",
            "camera.size_mismatch",
            "camera",
        ),
        (
            {"options": pb2.LocalizeOptions(top_k=0)},
            "INVALID_ARGUMENT",
            "options.top_k",
            "options.top_k",
        ),
        (
            {"options": pb2.LocalizeOptions(read_as="sideways")},
            "INVALID_ARGUMENT",
            "options.read_as",
            "options.read_as",
        ),
        (
            {"options": pb2.LocalizeOptions(extraction="thorough")},
            "INVALID_ARGUMENT",
            "options.extraction",
            "options.extraction",
        ),
        (
            {"options": pb2.LocalizeOptions(fusion="vote")},
            "INVALID_ARGUMENT",
            "options.fusion",
            "options.fusion",
        ),
        (
            {"options": pb2.LocalizeOptions(fusion_weights={"densevlad": float("nan")})},
            "INVALID_ARGUMENT",
            "options.fusion_weights",
            "options.fusion_weights.densevlad",
        ),
        (
            {"options": pb2.LocalizeOptions(matcher="")},
            "INVALID_ARGUMENT",
            "options.matcher",
            "options.matcher",
        ),
        (
            {"image": b"?", "options": pb2.LocalizeOptions(fusion_weights={"gem": 1})},
            "INVALID_ARGUMENT",
            "options.fusion_weights",
            "options.fusion_weights",
        ),
        (
            {"image": b"?", "options": pb2.LocalizeOptions(matcher="lightglue")},
            "INVALID_ARGUMENT",
            "options.matcher",
            "options.matcher",
        ),
        (
            {"options": pb2.LocalizeOptions(solver="p3p")},
            "INVALID_ARGUMENT",
            "options.solver",
            "options.solver",
        ),
    ],
)
def test_bad_input_has_the_matching_status_code_and_field(
    fields: dict[str, Any], status: str, code: str, field: str, doors: Any, query: Any
) -> None:
    info = refused(doors, request_for(query, **fields), grpc.StatusCode[status], code)

    assert info.metadata["field"] == field
    assert info.metadata["kind"] in ("InvalidInput", "TooLarge", "NotFound")
    assert info.metadata["message"]
    assert len(info.metadata["request_id"]) == 32


def test_a_message_over_the_limit_is_not_taken(doors: Any, query: Any) -> None:
    with pytest.raises(grpc.RpcError) as caught:
        doors.stub.Localize(request_for(query, image=bytes(1_000_000)))
    call: Any = caught.value
    assert call.code() == grpc.StatusCode.RESOURCE_EXHAUSTED


METHODS = [
    (service.full_name, method.name)
    for service in pb2.DESCRIPTOR.services_by_name.values()
    for method in service.methods
]
A_START = pb2.LocalizeSequenceRequest(start=pb2.SequenceStart(map="room")).SerializeToString()


@pytest.mark.parametrize(
    ("service", "method", "before"),
    [*((*each, []) for each in METHODS), (SERVICE_NAMES[0], "LocalizeSequence", [A_START])],
)
def test_a_message_that_is_no_protobuf_is_refused_counted_and_logged_in_a_line(
    service: str,
    method: str,
    before: list[bytes],
    doors: Any,
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    metrics = doors.server.observer.metrics
    labels = f'door="grpc",route="{method}",status="INVALID_ARGUMENT"'
    requests, errors = (
        f"visloc_requests_total{{{labels}}}",
        'visloc_errors_total{code="request.malformed",door="grpc",kind="InvalidInput"}',
    )
    counted = [value_of(metrics, name) for name in (requests, errors)]
    call = doors.channel.stream_stream(f"/{service}/{method}")
    with pytest.raises(grpc.RpcError) as caught:
        list(call(iter([*before, b"\xff" * 10])))

    info = info_of(caught.value, grpc.StatusCode.INVALID_ARGUMENT, "request.malformed")
    assert info.metadata["kind"] == "InvalidInput"
    assert len(info.metadata["request_id"]) == 32
    deadline = time.monotonic() + 20
    while not (lines := lines_of(caplog, "request.malformed")) and time.monotonic() < deadline:
        time.sleep(0.01)  # the caller is answered first
    (line,) = lines
    assert (line["route"], line["status"]) == (method, "INVALID_ARGUMENT")
    assert not any(record.exc_info for record in caplog.records)
    assert value_of(metrics, requests) > counted[0]
    assert value_of(metrics, errors) == counted[1] + 1


def test_a_message_of_very_many_fields_is_refused_before_it_is_parsed(doors: Any) -> None:
    call = doors.channel.unary_unary(f"/{SERVICE_NAMES[0]}/LocalizeRig")
    image = pb2.LocalizeRigRequest()
    image.images.add()
    with pytest.raises(grpc.RpcError) as caught:
        call(image.SerializeToString() * 100_001)

    info = info_of(caught.value, grpc.StatusCode.RESOURCE_EXHAUSTED, "request.too_large")
    assert info.metadata["expected"] == "at most 100000"


def lines_of(caplog: pytest.LogCaptureFixture, code: str) -> list[dict[str, Any]]:
    """What the access log has of requests that were refused with a code."""
    every = [getattr(record, "facts", {}) for record in caplog.records]
    return [facts for facts in every if facts.get("code") == code]


def value_of(metrics: Metrics, sample: str) -> float:
    text = metrics.render(ServiceState(ready=True))[0].decode()
    return next(
        (float(line.rpartition(" ")[2]) for line in text.splitlines() if line.startswith(sample)),
        0.0,
    )


def test_who_watches_health_leaves_room_for_others(serve: Any, tmp_path: Any) -> None:
    with serve(tmp_path, load=False, max_connections=8) as doors:
        stub = health_pb2_grpc.HealthStub(doors.channel)
        watching = [stub.Watch(health_pb2.HealthCheckRequest()) for _ in range(4)]
        for watch in watching:
            next(watch)
        with pytest.raises(grpc.RpcError) as caught:
            next(stub.Watch(health_pb2.HealthCheckRequest()))
        call: Any = caught.value
        assert call.code() == grpc.StatusCode.RESOURCE_EXHAUSTED
        assert doors.stub.ListMaps(pb2.ListMapsRequest()).maps == []
        for watch in watching:
            watch.cancel()


def test_the_end_of_watching_health_is_told_and_no_failure(
    serve: Any, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.grpc.access._KEYLESS_S", 0.1)
    with serve(tmp_path, load=False) as doors:
        watch = health_pb2_grpc.HealthStub(doors.channel).Watch(health_pb2.HealthCheckRequest())
        with pytest.raises(grpc.RpcError) as caught:
            list(watch)
        info_of(caught.value, grpc.StatusCode.DEADLINE_EXCEEDED, "request.deadline")
        metrics = doors.server.observer.metrics
        assert value_of(metrics, 'visloc_errors_total{code="request.deadline"') == 0


def test_what_breaks_inside_is_internal_without_its_insides(
    doors: Any, query: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async def broken(*_: Any) -> NoReturn:
        raise ZeroDivisionError("division")

    monkeypatch.setattr(doors.server.engine.workers, "run", broken)
    info = refused(doors, request_for(query), grpc.StatusCode.INTERNAL, "server.internal")

    assert "division" not in str(info)
    assert "ZeroDivisionError" in caplog.text


@pytest.mark.parametrize("cancel", [True, False], ids=["cancelled", "deadline"])
def test_the_work_for_a_call_that_is_given_up_is_given_up(
    cancel: bool, doors: Any, query: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, dropped = threading.Event(), threading.Event()

    async def for_ever(_: RigJob) -> NoReturn:
        begun.set()
        try:
            await asyncio.Event().wait()
        finally:
            dropped.set()

    monkeypatch.setattr(doors.server.engine, "localize", for_ever)
    call = doors.stub.Localize.future(request_for(query), timeout=None if cancel else 0.5)
    if cancel:
        assert begun.wait(10)
        call.cancel()
    else:
        assert call.exception(10).code() == grpc.StatusCode.DEADLINE_EXCEEDED

    assert dropped.wait(10)


def test_maps_are_listed_and_described_as_over_http(doors: Any) -> None:
    listed = doors.stub.ListMaps(pb2.ListMapsRequest())
    described = doors.stub.GetMap(pb2.GetMapRequest(map="room"))
    over_http = doors.http.get("/maps/room").json()

    assert list(listed.maps) == [described]
    assert bits(plain(described)) == bits(over_http)


def test_an_unknown_map_cannot_be_described(doors: Any) -> None:
    with pytest.raises(grpc.RpcError) as caught:
        doors.stub.GetMap(pb2.GetMapRequest(map="hall"))
    call: Any = caught.value
    assert call.code() == grpc.StatusCode.NOT_FOUND


def test_health_says_serving_only_when_the_maps_are_warm(
    doors: Any, serve: Any, built_maps: Any
) -> None:
    def health(doors: Any) -> list[int]:
        stub = health_pb2_grpc.HealthStub(doors.channel)
        return [
            stub.Check(health_pb2.HealthCheckRequest(service=name)).status
            for name in ("", SERVICE_NAMES[0])
        ]

    serving = health_pb2.HealthCheckResponse.SERVING
    not_serving = health_pb2.HealthCheckResponse.NOT_SERVING
    with serve(built_maps, load=False) as starting:
        assert health(starting) == [not_serving, not_serving]
    assert health(doors) == [serving, serving]


def test_reflection_lists_the_service(doors: Any) -> None:
    stub = reflection_pb2_grpc.ServerReflectionStub(doors.channel)
    asked = reflection_pb2.ServerReflectionRequest(list_services="")

    (answer,) = stub.ServerReflectionInfo(iter([asked]))

    names = {service.name for service in answer.list_services_response.service}
    assert {"visloc.v1.Localization", "grpc.health.v1.Health"} <= names
