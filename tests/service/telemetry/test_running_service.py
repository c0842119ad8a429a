"""Metrics, traces and logs of a service that runs."""

from __future__ import annotations

import logging
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import grpc
import httpx
import pytest
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest
from prometheus_client.parser import text_string_to_metric_families

from visloc_api.v1 import localization_pb2 as pb2

TRACE, SPAN = "0af7651916cd43dd8448eb211c80319c", "b7ad6b7169203331"
TRACEPARENT = f"00-{TRACE}-{SPAN}-01"


class _Handler(BaseHTTPRequestHandler):
    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        exports: list[ExportTraceServiceRequest] = self.server.exports  # type: ignore[attr-defined]
        exports.append(ExportTraceServiceRequest.FromString(body))
        self.send_response(200)
        self.end_headers()

    def log_message(self, *_: object) -> None:
        pass


@dataclass(frozen=True)
class Watched:
    """What was seen of a service that answered a photo over both doors and was then stopped."""

    http: httpx.Response
    grpc_headers: dict[str, Any]
    own_port: httpx.Response
    not_on_own_port: httpx.Response
    scrape: httpx.Response
    lines: list[dict[str, Any]]
    spans: list[Any]

    def value(self, name: str, **labels: str) -> float:
        return sum(
            sample.value
            for family in text_string_to_metric_families(self.scrape.text)
            for sample in family.samples
            if sample.name == name and labels.items() <= sample.labels.items()
        )


class _Kept(logging.Handler):
    def __init__(self) -> None:
        super().__init__()
        self.lines: list[dict[str, Any]] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(vars(record)["facts"])


@pytest.fixture(scope="module")
def watched(
    serve: Callable[..., AbstractContextManager[Any]], built_maps: Path, query: Any
) -> Iterator[Watched]:
    kept, log = _Kept(), logging.getLogger("service.access")
    log.addHandler(kept)
    log.setLevel(logging.INFO)
    collector = HTTPServer(("127.0.0.1", 0), _Handler)
    collector.exports = []  # type: ignore[attr-defined]
    thread = threading.Thread(target=collector.serve_forever, args=(0.02,))
    thread.start()
    camera = query.camera
    try:
        endpoint = f"http://127.0.0.1:{collector.server_port}"
        with serve(built_maps, metrics_port=0, otlp_endpoint=endpoint) as doors:
            form = {
                "map": "room",
                "camera": ",".join(
                    map(str, (camera.model, camera.width, camera.height, *camera.params))
                ),
            }
            files = {"image": ("photo.jpg", query.image, "image/jpeg")}
            answer = doors.http.post(
                "/localize", data=form, files=files, headers={"traceparent": TRACEPARENT}
            )
            doors.http.post("/localize", data={**form, "map": "cellar"}, files=files)
            doors.http.get("/no/such/path")
            _, call = doors.stub.ListMaps.with_call(
                pb2.ListMapsRequest(), metadata=(("traceparent", TRACEPARENT),)
            )
            with pytest.raises(grpc.RpcError):
                doors.stub.GetMap(pb2.GetMapRequest(map="cellar"))
            port = doors.server.metrics_port
            own = httpx.get(f"http://127.0.0.1:{port}/metrics")
            other = httpx.get(f"http://127.0.0.1:{port}/maps")
            scrape = doors.http.get("/metrics")
        spans = [
            span
            for export in collector.exports  # type: ignore[attr-defined]
            for resource in export.resource_spans
            for scope in resource.scope_spans
            for span in scope.spans
        ]
        yield Watched(answer, dict(call.initial_metadata()), own, other, scrape, kept.lines, spans)
    finally:
        collector.shutdown()
        thread.join()
        collector.server_close()
        log.removeHandler(kept)
        log.setLevel(logging.NOTSET)


def test_a_photo_is_in_the_metrics_with_map_outcome_inliers_and_stages(watched: Watched) -> None:
    assert watched.http.json()["status"] == "localized"

    assert watched.value("visloc_localizations_total", map="room", outcome="localized") == 1
    assert watched.value("visloc_localizations_total") == 1
    inliers = watched.http.json()["inliers"]
    assert watched.value("visloc_localization_inliers_sum", map="room") == inliers
    for stage in watched.http.json()["seconds"]:
        assert watched.value("visloc_stage_seconds_count", stage=stage) == 1


def test_requests_are_counted_by_template_and_status(watched: Watched) -> None:
    route = {"door": "http", "route": "POST /localize"}
    assert watched.value("visloc_requests_total", **route, status="200") == 1
    assert watched.value("visloc_requests_total", **route, status="404") == 1
    assert watched.value("visloc_requests_total", door="http", route="unmatched") == 1
    assert watched.value("visloc_requests_total", door="grpc", route="GetMap") == 1
    assert watched.value("visloc_errors_total", door="http", code="map.unknown") == 1
    assert watched.value("visloc_errors_total", door="grpc", code="map.unknown") == 1
    assert watched.value("visloc_errors_total", code="server.internal") == 0
    assert "cellar" not in watched.scrape.text
    assert "no/such" not in watched.scrape.text


def test_the_state_of_the_service_is_in_the_metrics(watched: Watched) -> None:
    assert watched.value("visloc_ready") == 1
    assert watched.value("visloc_workers") == watched.value("visloc_workers_alive") == 1
    assert watched.value("visloc_loaded_map_bytes", map="room") > 0
    assert watched.value("visloc_photos_running") == watched.value("visloc_photos_waiting") == 0
    assert watched.value("visloc_resident_memory_bytes", process="worker-0") > 2**20
    assert watched.value("visloc_disk_free_bytes", folder="maps") > 0


def test_the_port_of_metrics_has_metrics_only(watched: Watched) -> None:
    assert watched.own_port.status_code == 200
    assert "visloc_ready 1.0\n" in watched.own_port.text
    assert watched.not_on_own_port.status_code == 404


def test_both_doors_take_up_the_callers_trace(watched: Watched) -> None:
    over_http = watched.http.headers["traceresponse"]
    over_grpc = watched.grpc_headers["traceresponse"]

    for answer in (over_http, over_grpc):
        assert re.fullmatch(rf"00-{TRACE}-[0-9a-f]{{16}}-01", answer)
    assert over_http != over_grpc


def test_the_collector_gets_the_request_and_its_stages(watched: Watched) -> None:
    (request,) = (s for s in watched.spans if s.parent_span_id.hex() == SPAN and "POST" in s.name)

    assert request.name == "http POST /localize"
    assert request.trace_id.hex() == TRACE
    assert request.span_id.hex() == watched.http.headers["traceresponse"].split("-")[2]
    stages = [s for s in watched.spans if s.parent_span_id == request.span_id]
    assert [stage.name for stage in stages] == list(watched.http.json()["seconds"])
    for stage in stages:
        # They are laid out by their lengths, so the first may begin a little early.
        assert stage.end_time_unix_nano <= request.end_time_unix_nano
        assert stage.start_time_unix_nano > request.start_time_unix_nano - 50_000_000


def test_every_request_has_one_line_in_the_log(watched: Watched) -> None:
    found = [(line["door"], line["route"], line["status"]) for line in watched.lines]

    assert found == [
        ("http", "POST /localize", "200"),
        ("http", "POST /localize", "404"),
        ("http", "unmatched", "404"),
        ("grpc", "ListMaps", "OK"),
        ("grpc", "GetMap", "NOT_FOUND"),
    ]
    assert (watched.lines[0]["map"], watched.lines[0]["outcome"]) == ("room", "localized")
    assert watched.lines[1]["code"] == "map.unknown"
