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
from opentelemetry.sdk.trace.export import SpanExportResult
from opentelemetry.trace import SpanContext

from service.settings import ServiceSettings, SettingsError
from service.telemetry.tracing import (
    RequestSpan,
    Spans,
    child_of,
    new_trace,
    open_spans,
    parse_traceparent,
    stages_until,
    traceparent_of,
)

TRACE, SPAN = "0af7651916cd43dd8448eb211c80319c", "b7ad6b7169203331"


def caller_of(flags: str = "01") -> SpanContext:
    caller = parse_traceparent(f"00-{TRACE}-{SPAN}-{flags}")
    assert caller is not None
    return caller


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


@pytest.mark.parametrize(
    ("header", "sampled"),
    [
        (f"00-{TRACE}-{SPAN}-01", True),
        (f"00-{TRACE}-{SPAN}-00", False),
        (f"00-{TRACE}-{SPAN}-02", False),
        (f"cc-{TRACE}-{SPAN}-03-more", True),  # later versions may say more, at the end
        (f" 00-{TRACE}-{SPAN}-01\t", True),  # white space around it is not part of a header
    ],
)
def test_a_traceparent_is_read_and_answered(header: str, sampled: bool) -> None:
    caller = parse_traceparent(header)

    assert caller is not None
    assert (caller.trace_id, caller.span_id) == (int(TRACE, 16), int(SPAN, 16))
    assert caller.trace_flags.sampled == sampled
    child = child_of(caller)
    answered = traceparent_of(child)
    assert answered == f"00-{TRACE}-{child.span_id:016x}-0{int(sampled)}"
    assert child.span_id != caller.span_id


@pytest.mark.parametrize(
    "header",
    [
        None,
        "",
        "00",
        f"00-{TRACE}-{SPAN}",
        f"00-{TRACE}-{SPAN}-01-more",
        f"ff-{TRACE}-{SPAN}-01",
        f"00-{'0' * 32}-{SPAN}-01",
        f"00-{TRACE}-{'0' * 16}-01",
        f"00-{TRACE.upper()}-{SPAN}-01",
        f"00-{TRACE[:-1]}-{SPAN}-01",
        f"00-{TRACE[:-1]}\u0663-{SPAN}-01",  # a digit, in Arabic
        f"cc-{TRACE}-{SPAN}-01-" + 10_000 * "x",
    ],
)
def test_a_wrong_traceparent_is_none(header: str | None) -> None:
    assert parse_traceparent(header) is None


@given(st.text() | st.from_regex(r"[0-9a-f]{2}-[0-9a-f]{32}-[0-9a-f]{16}-[0-9a-f]{2}.*"))
def test_whatever_a_caller_sends_a_trace_id_is_32_hexadecimal_digits(header: str) -> None:
    found = parse_traceparent(header)

    if found is not None:
        own = traceparent_of(child_of(found))
        assert own.startswith(f"00-{found.trace_id:032x}-")
        assert len(own) == len(f"00-{TRACE}-{SPAN}-01")
        assert parse_traceparent(own) is not None


def test_a_new_trace_is_sampled_and_has_ids_of_its_own() -> None:
    one, other = new_trace(), new_trace()

    assert one.trace_flags.sampled
    assert one.trace_id != other.trace_id
    assert one.span_id != other.span_id


def test_stages_end_now_and_follow_one_another() -> None:
    queued, pose = stages_until(10_000_000_000, {"queued": 1.0, "pose": 0.5})

    assert (queued.name, queued.start_ns, queued.end_ns) == (
        "queued",
        8_500_000_000,
        9_500_000_000,
    )
    assert (pose.name, pose.start_ns, pose.end_ns) == ("pose", 9_500_000_000, 10_000_000_000)
    assert stages_until(10, {}) == ()


def span_of(context: SpanContext, caller: SpanContext | None = None) -> RequestSpan:
    now = time.time_ns()
    return RequestSpan(
        "http POST /localize",
        context,
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
    caller = caller_of()
    sent = span_of(child_of(caller), caller)
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
    assert int.from_bytes(request.span_id) == sent.context.span_id
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
    good = span_of(new_trace())

    spans.send(
        RequestSpan(
            good.name, good.context, None, good.start_ns, good.end_ns, {}, failed=True, stages=()
        )
    )
    spans.close()

    assert collector.paths == ["/other/path"]
    (request,) = collector.spans
    assert request.status.code == request.status.STATUS_CODE_ERROR
    assert request.parent_span_id == b""


def test_a_trace_that_its_caller_does_not_record_is_not_sent(collector: Collector) -> None:
    caller = caller_of("00")
    spans = Spans(collector.url)

    spans.send(span_of(child_of(caller), caller))
    spans.close()

    assert collector.exports == []


def test_requests_do_not_wait_for_a_collector(
    collector: Collector, monkeypatch: pytest.MonkeyPatch
) -> None:
    spans = Spans(collector.url)
    go_on, waited = threading.Event(), threading.Event()

    def export(_: object) -> SpanExportResult:
        go_on.wait(60)
        waited.set()
        return SpanExportResult.FAILURE

    monkeypatch.setattr(spans._exporter, "export", export)
    for _ in range(3000):  # more than wait
        spans.send(span_of(new_trace()))
    assert not waited.is_set()
    go_on.set()
    spans.close()


def test_a_collector_that_is_away_does_not_delay_the_end_for_long(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        port = unused.getsockname()[1]
    spans = Spans(f"http://127.0.0.1:{port}")
    caplog.set_level(logging.CRITICAL, "opentelemetry")

    spans.send(span_of(new_trace()))
    start = time.perf_counter()
    spans.close()
    assert time.perf_counter() - start < 25  # without a limit, half a minute


def test_no_endpoint_no_spans() -> None:
    assert open_spans(ServiceSettings()) is None


@pytest.mark.parametrize("endpoint", ["collector:4318", "ftp://collector", "http://", ""])
def test_an_endpoint_that_is_no_url_is_refused(endpoint: str) -> None:
    with pytest.raises(SettingsError, match="otlp_endpoint cannot be"):
        open_spans(ServiceSettings(otlp_endpoint=endpoint))


def test_without_the_packages_it_is_said_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    module = "opentelemetry.exporter.otlp.proto.http.trace_exporter"
    monkeypatch.setitem(sys.modules, module, None)

    with pytest.raises(SettingsError, match="its extra tracing"):
        Spans("http://127.0.0.1:4318")
