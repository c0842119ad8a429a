"""Traces: whose request this is (W3C Trace Context), and spans for an OpenTelemetry collector.

Trace ids are followed into logs and answers with or without a collector; the packages that speak
to one are only imported when there is one.
"""

from __future__ import annotations

import re
import secrets
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from urllib.parse import urlsplit

import visloc
from service.settings import ServiceSettings, SettingsError

SERVICE_NAME = "visloc"
# Where OTLP over HTTP takes spans, when the endpoint names a host only.
_TRACES_PATH = "/v1/traces"
# Spans that wait for a collector that is slow or away; beyond it they are dropped.
_MAX_WAITING_SPANS = 2048
_MAX_EXPORTED_SPANS = 512
_EXPORT_EVERY_MS = 2000
_EXPORT_TIMEOUT_S = 5.0
_CLOSE_TIMEOUT_S = 3.0

# https://www.w3.org/TR/trace-context/#traceparent-header: a later version may append fields.
_TRACEPARENT = re.compile(r"([0-9a-f]{2})-([0-9a-f]{32})-([0-9a-f]{16})-([0-9a-f]{2})(-.*)?")


@dataclass(frozen=True, slots=True)
class TraceContext:
    """A place in a trace.

    Attributes:
        trace_id: 32 hexadecimal digits.
        span_id: 16 hexadecimal digits.
        sampled: whether the caller records the trace.
    """

    trace_id: str
    span_id: str
    sampled: bool

    @property
    def traceparent(self) -> str:
        """The header that says it: ``traceparent`` of requests, ``traceresponse`` of answers."""
        return f"00-{self.trace_id}-{self.span_id}-{int(self.sampled):02x}"


def parse_traceparent(header: str | None) -> TraceContext | None:
    """Return what a caller's header says; None for none and, as is the standard, a wrong one."""
    found = _TRACEPARENT.fullmatch(header or "")
    if found is None:
        return None
    version, trace_id, span_id, flags, more = found.groups()
    if version == "ff" or (version == "00" and more is not None):
        return None
    if not trace_id.strip("0") or not span_id.strip("0"):
        return None
    return TraceContext(trace_id, span_id, bool(int(flags, 16) & 1))


def continued(caller: TraceContext) -> TraceContext:
    """Return a place of our own in the caller's trace."""
    return TraceContext(caller.trace_id, secrets.token_hex(8), caller.sampled)


def started_trace() -> TraceContext:
    """Return a place in a trace of our own."""
    return TraceContext(secrets.token_hex(16), secrets.token_hex(8), True)


@dataclass(frozen=True, slots=True)
class Stage:
    """A stage of the work for a photo; times in ns since 1970."""

    name: str
    start_ns: int
    end_ns: int


@dataclass(frozen=True, slots=True)
class RequestSpan:
    """What is told of a request that ended.

    Attributes:
        name: its route.
        place: where it stands in its trace.
        caller: the span that it is part of; None for none.
        start_ns: since 1970.
        end_ns: since 1970.
        attributes: by the names of OpenTelemetry's semantic conventions where there is one.
        failed: whether that was the server's fault.
        stages: of its work.
    """

    name: str
    place: TraceContext
    caller: TraceContext | None
    start_ns: int
    end_ns: int
    attributes: Mapping[str, str | int | float]
    failed: bool
    stages: tuple[Stage, ...]


def stages_until(end_ns: int, seconds: Mapping[str, float]) -> tuple[Stage, ...]:
    """Lay stages that ran one after the other on the clock (ns since 1970), the last until now."""
    start = end_ns - sum(round(duration * 1e9) for duration in seconds.values())
    stages = []
    for name, duration in seconds.items():
        stages.append(Stage(name, start, start + round(duration * 1e9)))
        start = stages[-1].end_ns
    return tuple(stages)


class Spans:
    """Sends spans to a collector from a thread of its own; one that is away costs nothing else.

    Args:
        endpoint: URL of the collector; ``/v1/traces`` is added to one without a path.

    Raises:
        SettingsError: when the URL cannot be used, or the packages are not installed.
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
                f"otlp_endpoint needs the package {missing.name}: install visloc[tracing], or "
                "leave otlp_endpoint out"
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
        """Take a request and its stages; unless its caller does not record the trace."""
        from opentelemetry.sdk.trace import ReadableSpan
        from opentelemetry.trace import SpanContext, SpanKind, Status, StatusCode, TraceFlags

        def context_of(place: TraceContext, *, remote: bool) -> SpanContext:
            flags = TraceFlags(TraceFlags.SAMPLED if place.sampled else TraceFlags.DEFAULT)
            return SpanContext(int(place.trace_id, 16), int(place.span_id, 16), remote, flags)

        own = context_of(request.place, remote=False)
        self._processor.on_end(
            ReadableSpan(
                request.name,
                own,
                None if request.caller is None else context_of(request.caller, remote=True),
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
                    context_of(continued(request.place), remote=False),
                    own,
                    self._resource,
                    start_time=stage.start_ns,
                    end_time=stage.end_ns,
                )
            )

    def close(self) -> None:
        """Send what waits, as far as the collector takes it within seconds. Blocks."""
        # Only the exporter's end stops its attempts; the processor would wait for half a minute.
        giving_up = threading.Timer(_CLOSE_TIMEOUT_S, self._exporter.shutdown)
        giving_up.daemon = True
        giving_up.start()
        self._processor.shutdown()  # type: ignore[no-untyped-call]
        giving_up.cancel()


def open_spans(settings: ServiceSettings) -> Spans | None:
    """Return where spans go; None when the settings name no collector.

    Raises:
        SettingsError: as of ``Spans``.
    """
    return None if settings.otlp_endpoint is None else Spans(settings.otlp_endpoint)
