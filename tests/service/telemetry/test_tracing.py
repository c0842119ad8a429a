from __future__ import annotations

import logging
import socket
import sys
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest
from hypothesis import given
from hypothesis import strategies as st
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest

from service.settings import ServiceSettings, SettingsError
from service.telemetry.tracing import (
    RequestSpan,
    Spans,
    TraceContext,
    continued,
    open_spans,
    parse_traceparent,
    stages_until,
    started_trace,
)

TRACE, SPAN = "0af7651916cd43dd8448eb211c80319c", "b7ad6b7169203331"


class Collector(HTTPServer):
    """What takes spans over OTLP/HTTP."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.paths: list[str] = []
        self.exports: list[ExportTraceServiceRequest] = []

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"

    @property
    def spans(self) -> list[object]:
        return [
            span
            for export in self.exports
            for resource in export.resource_spans
            for scope in resource.scope_spans
            for span in scope.spans
        ]


class _Handler(BaseHTTPRequestHandler):
    server: Collector

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.server.paths.append(self.path)
        self.server.exports.append(ExportTraceServiceRequest.FromString(body))
        self.send_response(200)
        self.end_headers()

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def collector() -> Iterator[Collector]:
    with Collector() as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def test_a_traceparent_is_read_and_written() -> None:
    header = f"00-{TRACE}-{SPAN}-01"

    found = parse_traceparent(header)

    assert found == TraceContext(TRACE, SPAN, True)
    assert found.traceparent == header
    assert parse_traceparent(f"00-{TRACE}-{SPAN}-00") == TraceContext(TRACE, SPAN, False)
    # Later versions may say more, at the end.
    assert parse_traceparent(f"cc-{TRACE}-{SPAN}-03-more") == TraceContext(TRACE, SPAN, True)


@pytest.mark.parametrize(
    "header",
    [
        None,
        "",
        "00",
        f"00-{TRACE}-{SPAN}",
        f"00-{TRACE}-{SPAN}-01-more",
        f"00-{TRACE}-{SPAN}-01\n",
        f"ff-{TRACE}-{SPAN}-01",
        f"00-{'0' * 32}-{SPAN}-01",
        f"00-{TRACE}-{'0' * 16}-01",
        f"00-{TRACE.upper()}-{SPAN}-01",
        f"00-{TRACE[:-1]}-{SPAN}-01",
        f"00-{TRACE[:-1]}\u0663-{SPAN}-01",  # a digit, in Arabic
        f" 00-{TRACE}-{SPAN}-01",
    ],
)
def test_a_wrong_traceparent_is_none(header: str | None) -> None:
    assert parse_traceparent(header) is None


@given(st.text() | st.from_regex(r"[0-9a-f]{2}-[0-9a-f]{32}-[0-9a-f]{16}-[0-9a-f]{2}.*"))
def test_whatever_a_caller_sends_a_trace_id_is_32_hexadecimal_digits(header: str) -> None:
    found = parse_traceparent(header)

    if found is not None:
        assert parse_traceparent(found.traceparent) == found
        assert len(found.trace_id) == 32
        assert int(found.trace_id, 16) > 0


def test_a_trace_goes_on_in_a_span_of_its_own() -> None:
    caller = TraceContext(TRACE, SPAN, False)

    own, fresh = continued(caller), started_trace()

    assert (own.trace_id, own.sampled) == (TRACE, False)
    assert own.span_id != SPAN
    assert fresh.sampled
    for place in (own, fresh):
        assert parse_traceparent(place.traceparent) == place


def test_stages_end_now_and_follow_one_another() -> None:
    queued, pose = stages_until(10_000_000_000, {"queued": 1.0, "pose": 0.5})

    assert (queued.name, queued.start_ns, queued.end_ns) == (
        "queued",
        8_500_000_000,
        9_500_000_000,
    )
    assert (pose.name, pose.start_ns, pose.end_ns) == ("pose", 9_500_000_000, 10_000_000_000)
    assert stages_until(10, {}) == ()


def span_of(place: TraceContext, caller: TraceContext | None = None) -> RequestSpan:
    now = time.time_ns()
    return RequestSpan(
        "http POST /localize",
        place,
        caller,
        now - 2_000_000_000,
        now,
        {"http.response.status_code": 200, "visloc.map": "hall"},
        False,
        stages_until(now, {"queued": 0.5, "pose": 1.0}),
    )


def test_a_collector_gets_the_request_under_its_caller_and_the_stages_under_it(
    collector: Collector,
) -> None:
    caller = TraceContext(TRACE, SPAN, True)
    sent = span_of(continued(caller), caller)
    spans = Spans(collector.url)

    spans.send(sent)
    spans.close()

    assert collector.paths == ["/v1/traces"]
    (resource,) = collector.exports[0].resource_spans
    about = {a.key: a.value.string_value for a in resource.resource.attributes}
    assert about["service.name"] == "visloc"
    request, queued, pose = collector.spans
    assert request.trace_id.hex() == TRACE
    assert request.parent_span_id.hex() == SPAN
    assert request.span_id.hex() == sent.place.span_id
    assert request.name == "http POST /localize"
    assert request.kind == request.SPAN_KIND_SERVER
    attributes = {a.key: a.value for a in request.attributes}
    assert attributes["http.response.status_code"].int_value == 200
    assert attributes["visloc.map"].string_value == "hall"
    assert request.end_time_unix_nano - request.start_time_unix_nano == 2_000_000_000
    assert (queued.name, pose.name) == ("queued", "pose")
    assert len({request.span_id, queued.span_id, pose.span_id}) == 3
    for stage in (queued, pose):
        assert stage.trace_id == request.trace_id
        assert stage.parent_span_id == request.span_id
    assert pose.start_time_unix_nano == queued.end_time_unix_nano
    assert pose.end_time_unix_nano - pose.start_time_unix_nano == 1_000_000_000


def test_a_request_that_failed_by_the_servers_fault_is_marked(collector: Collector) -> None:
    spans = Spans(collector.url + "/other/path")
    good = span_of(started_trace())

    spans.send(
        RequestSpan(
            good.name, good.place, None, good.start_ns, good.end_ns, {}, failed=True, stages=()
        )
    )
    spans.close()

    assert collector.paths == ["/other/path"]
    (request,) = collector.spans
    assert request.status.code == request.status.STATUS_CODE_ERROR
    assert request.parent_span_id == b""


def test_a_trace_that_its_caller_does_not_record_is_not_sent(collector: Collector) -> None:
    caller = TraceContext(TRACE, SPAN, False)
    spans = Spans(collector.url)

    spans.send(span_of(continued(caller), caller))
    spans.close()

    assert collector.exports == []


def test_a_collector_that_is_away_delays_neither_requests_nor_the_end_for_long(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        port = unused.getsockname()[1]
    spans = Spans(f"http://127.0.0.1:{port}")
    caplog.set_level(logging.CRITICAL, "opentelemetry")

    start = time.perf_counter()
    for _ in range(3000):  # more than wait
        spans.send(span_of(started_trace()))
    sent = time.perf_counter()
    spans.close()

    assert sent - start < 5
    assert time.perf_counter() - sent < 15


def test_no_endpoint_no_spans() -> None:
    assert open_spans(ServiceSettings()) is None


@pytest.mark.parametrize("endpoint", ["collector:4318", "ftp://collector", "http://", ""])
def test_an_endpoint_that_is_no_url_is_refused(endpoint: str) -> None:
    with pytest.raises(SettingsError, match="otlp_endpoint cannot be"):
        open_spans(ServiceSettings(otlp_endpoint=endpoint))


def test_without_the_packages_it_is_said_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    module = "opentelemetry.exporter.otlp.proto.http.trace_exporter"
    monkeypatch.setitem(sys.modules, module, None)

    with pytest.raises(SettingsError, match=r"visloc\[tracing\]"):
        Spans("http://127.0.0.1:4318")
