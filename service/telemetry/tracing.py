"""Trace ids (W3C Trace Context) and spans for an OpenTelemetry collector.

Logs and answers carry trace ids with or without a collector. The packages that talk to a collector
are imported only when the settings name one.
"""

from __future__ import annotations

import secrets
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from urllib.parse import urlsplit

from opentelemetry.context import Context
from opentelemetry.trace import (
    NonRecordingSpan,
    SpanContext,
    TraceFlags,
    get_current_span,
    set_span_in_context,
)
from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

import visloc
from service.settings import ServiceSettings, SettingsError

SERVICE_NAME = "visloc"
# The path of OTLP over HTTP, added to an endpoint without one.
_TRACES_PATH = "/v1/traces"
# Spans that wait for a slow or absent collector; more are dropped.
_MAX_WAITING_SPANS = 2048
_MAX_EXPORTED_SPANS = 512
_EXPORT_EVERY_MS = 2000
_EXPORT_TIMEOUT_S = 5.0
_CLOSE_TIMEOUT_S = 3.0

_PROPAGATOR = TraceContextTextMapPropagator()
_HEADER = "traceparent"


def parse_traceparent(header: str | None) -> SpanContext | None:
    """Return the caller's span; None when the header is missing or, as W3C asks, malformed."""
    if header is None:
        return None
    # The context is given, or the propagator would look for the current one.
    context = _PROPAGATOR.extract({_HEADER: header}, Context())
    caller = get_current_span(context).get_span_context()
    return caller if caller.is_valid else None


def traceparent_of(span: SpanContext) -> str:
    """Return the header of a span: ``traceparent`` of requests, ``traceresponse`` of answers."""
    carrier: dict[str, str] = {}
    _PROPAGATOR.inject(carrier, set_span_in_context(NonRecordingSpan(span), Context()))
    return carrier[_HEADER]


def child_of(parent: SpanContext) -> SpanContext:
    """Return a new span in the same trace; it is sampled if the parent is."""
    return _new_span(parent.trace_id, sampled=parent.trace_flags.sampled)


def new_trace() -> SpanContext:
    """Return the first span of a new trace, sampled."""
    return _new_span(_random_id(128), sampled=True)


def _new_span(trace_id: int, *, sampled: bool) -> SpanContext:
    flags = TraceFlags(TraceFlags.SAMPLED if sampled else TraceFlags.DEFAULT)
    return SpanContext(trace_id, _random_id(64), is_remote=False, trace_flags=flags)


def _random_id(bits: int) -> int:
    return secrets.randbits(bits) or 1  # 0 stands for none


@dataclass(frozen=True, slots=True)
class Stage:
    """A stage of the work for a photo; times in ns since 1970."""

    name: str
    start_ns: int
    end_ns: int


@dataclass(frozen=True, slots=True)
class RequestSpan:
    """A request that ended; times in ns since 1970.

    Attributes:
        context: the ids of its own span.
        caller: the caller's span, which is the parent.
        attributes: named by OpenTelemetry's semantic conventions where they have a name.
        failed: whether the error was the server's fault.
    """

    name: str
    context: SpanContext
    caller: SpanContext | None
    start_ns: int
    end_ns: int
    attributes: Mapping[str, str | int | float]
    failed: bool
    stages: tuple[Stage, ...]


def stages_until(end_ns: int, seconds: Mapping[str, float]) -> tuple[Stage, ...]:
    """Place consecutive stages on the clock (ns since 1970) so that the last ends at ``end_ns``."""
    start = end_ns - sum(round(duration * 1e9) for duration in seconds.values())
    stages = []
    for name, duration in seconds.items():
        stages.append(Stage(name, start, start + round(duration * 1e9)))
        start = stages[-1].end_ns
    return tuple(stages)


class Spans:
    """Sends spans to a collector from its own thread, so that an absent one delays no request.

    Args:
        endpoint: URL of the collector; ``/v1/traces`` is added to one without a path.
    """

    def __init__(self, endpoint: str) -> None:
        url = urlsplit(endpoint)
        if url.scheme not in ("http", "https") or not url.hostname:
            raise SettingsError(
                f"otlp_endpoint cannot be {endpoint!r}: expected a URL such as "
                "http://127.0.0.1:4318"
            )
        try:
            from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
            from opentelemetry.sdk.resources import Resource
            from opentelemetry.sdk.trace.export import BatchSpanProcessor
        except ModuleNotFoundError as missing:
            raise SettingsError(
                f"otlp_endpoint needs the package {missing.name}: install it, or visloc with its "
                "extra tracing, or leave otlp_endpoint out"
            ) from None
        if url.path in ("", "/"):
            url = url._replace(path=_TRACES_PATH)
        self._resource = Resource(
            {"service.name": SERVICE_NAME, "service.version": visloc.__version__}
        )
        self._exporter = OTLPSpanExporter(url.geturl(), timeout=_EXPORT_TIMEOUT_S)
        self._processor = BatchSpanProcessor(
            self._exporter,
            max_queue_size=_MAX_WAITING_SPANS,
            schedule_delay_millis=_EXPORT_EVERY_MS,
            max_export_batch_size=_MAX_EXPORTED_SPANS,
        )

    def send(self, request: RequestSpan) -> None:
        """Queue a request and its stages, unless the caller does not sample the trace."""
        from opentelemetry.sdk.trace import ReadableSpan
        from opentelemetry.trace import SpanKind, Status, StatusCode

        own = request.context
        self._processor.on_end(
            ReadableSpan(
                request.name,
                own,
                request.caller,
                self._resource,
                request.attributes,
                kind=SpanKind.SERVER,
                status=Status(StatusCode.ERROR if request.failed else StatusCode.UNSET),
                start_time=request.start_ns,
                end_time=request.end_ns,
            )
        )
        for stage in request.stages:
            self._processor.on_end(
                ReadableSpan(
                    stage.name,
                    child_of(own),
                    own,
                    self._resource,
                    start_time=stage.start_ns,
                    end_time=stage.end_ns,
                )
            )

    def close(self) -> None:
        """Send the waiting spans; give up after a few seconds. Blocks."""
        # Only the exporter's end stops its attempts; the processor would wait for half a minute.
        giving_up = threading.Timer(_CLOSE_TIMEOUT_S, self._exporter.shutdown)
        giving_up.daemon = True
        giving_up.start()
        self._processor.shutdown()  # type: ignore[no-untyped-call]
        giving_up.cancel()


def open_spans(settings: ServiceSettings) -> Spans | None:
    """Connect to the collector that the settings name, if any."""
    return None if settings.otlp_endpoint is None else Spans(settings.otlp_endpoint)
