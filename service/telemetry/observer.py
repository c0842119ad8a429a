"""Reports every request of both transports to the metrics, the log and the traces."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from time import perf_counter, time_ns

from service.errors import statuses_of
from service.telemetry.floods import Floods
from service.telemetry.logs import (
    UNMATCHED,
    RequestRecord,
    begin_request,
    current_request,
    end_request,
)
from service.telemetry.metrics import LOCALIZED, Metrics
from service.telemetry.tracing import (
    RequestSpan,
    Spans,
    child_of,
    new_trace,
    parse_traceparent,
    stages_until,
)
from service.values import Localization
from visloc.errors import VislocError

access_log = logging.getLogger("service.access")

# The status of a request whose caller left before the answer.
CANCELLED = "CANCELLED"
_TOO_SLOW = "request.too_slow"
# Probes come every few seconds: they are logged at level debug and have no spans.
_PROBES = ("GET /healthz", "GET /readyz", "GET /metrics")


class Observer:
    """Watches the requests of both transports.

    Args:
        spans: sends the spans of traced requests; None if tracing is off.
    """

    def __init__(self, metrics: Metrics, spans: Spans | None = None) -> None:
        self.metrics = metrics
        self._spans = spans
        self._floods = Floods()

    @contextmanager
    def request(
        self, door: str, request_id: str, *, route: str = UNMATCHED, traceparent: str | None = None
    ) -> Iterator[RequestRecord]:
        """Watch a request from its head to the end of its answer.

        The block sets the record's ``status`` when it answers, and ``route`` once it is known.

        Args:
            route: the method and the template of the path, or the name of the gRPC method.
            traceparent: the caller's header, unchecked.
        """
        caller = parse_traceparent(traceparent)
        trace = None
        if caller is not None:
            trace = child_of(caller)
        elif self._spans is not None:
            trace = new_trace()
        record = RequestRecord(door, request_id, trace, route=route)
        begin_request(record)
        self.metrics.request_started(door)
        started, started_ns = perf_counter(), time_ns()
        try:
            yield record
        finally:
            seconds = perf_counter() - started
            record.status = record.status or CANCELLED
            self.metrics.observe_request(door, record.route, record.status, seconds)
            self._log(record, seconds)
            if self._spans is not None and trace is not None and record.route not in _PROBES:
                self._spans.send(
                    RequestSpan(
                        f"{door} {record.route}",
                        trace,
                        caller,
                        started_ns,
                        started_ns + round(seconds * 1e9),
                        _attributes_of(record),
                        record.failed,
                        record.stages,
                    )
                )
            end_request()

    def error(self, error: VislocError) -> None:
        """Note the error that answers the current request."""
        record = current_request()
        if record is not None:
            record.code = error.code
            record.failed = statuses_of(error)[0] >= 500
            self.metrics.observe_error(record.door, error)

    def worker_ended(self) -> None:
        """Note a worker process that was ended because of the current request."""
        record = current_request()
        self.metrics.observe_worker_ended(None if record is None else record.key)

    def localization(self, found: Localization) -> None:
        """Note the answer to a photo."""
        self._answer(found)
        record = current_request()
        if record is not None:
            record.stages = stages_until(time_ns(), found.answer.seconds)

    def instant(self, found: Localization) -> None:
        """Note the answer to an instant; a pose filled in from its neighbours does not count."""
        self._answer(found)
        record = current_request()
        if record is not None:
            record.instants += 1
            record.localized += found.answer.refusal is None

    def _answer(self, found: Localization) -> None:
        answer = found.answer
        reason = None if answer.refusal is None else answer.refusal.reason.value
        self.metrics.observe_localization(found.map_id, reason, answer.num_inliers, answer.seconds)
        record = current_request()
        if record is not None:
            record.map, record.outcome = found.map_id, reason or LOCALIZED

    def _log(self, record: RequestRecord, seconds: float) -> None:
        facts: dict[str, object] = {
            "door": record.door,
            "route": record.route,
            "status": record.status,
            "ms": round(seconds * 1000, 1),
        }
        if record.instants > 1:
            facts |= {"map": record.map}
            facts |= {"instants": record.instants, "localized": record.localized}
        elif record.map is not None:
            facts |= {"map": record.map, "outcome": record.outcome}
        if record.code is not None:
            facts["code"] = record.code
            if record.code.startswith("access."):
                facts["peer"] = record.peer
        # What a client did not send or wait for: nothing was worked on, so it costs nobody much to
        # do it a thousand times a second.
        if record.status == CANCELLED or record.code == _TOO_SLOW:
            written, more = self._floods.passes(record.code or CANCELLED)
            if not written:
                return
            facts |= {"unlogged_before": more} if more else {}
        level = logging.DEBUG if record.route in _PROBES else logging.INFO
        access_log.log(level, "request", extra={"facts": facts})


def _attributes_of(record: RequestRecord) -> dict[str, str | int | float]:
    attributes: dict[str, str | int | float | None] = {"visloc.request_id": record.request_id}
    if record.door == "http":
        method, _, path = record.route.rpartition(" ")
        attributes |= {"http.route": path, "http.request.method": method or None}
        if record.status.isdigit():
            attributes["http.response.status_code"] = int(record.status)
    else:
        attributes |= {
            "rpc.system": "grpc",
            "rpc.method": record.route,
            "visloc.grpc.status": record.status,
        }
    attributes |= {
        "error.type": record.code,
        "visloc.map": record.map,
        "visloc.outcome": record.outcome,
    }
    if record.instants:
        attributes |= {"visloc.instants": record.instants, "visloc.localized": record.localized}
    return {name: value for name, value in attributes.items() if value is not None}
