"""What becomes of every request, told at one place to the metrics, the log and the traces."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from time import perf_counter, time_ns

from starlette.types import Scope

from service.errors import statuses_of
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
    continued,
    parse_traceparent,
    stages_until,
    started_trace,
)
from service.values import Localization
from visloc.errors import VislocError

access_log = logging.getLogger("service.security.access")

_METHODS = ("GET", "HEAD", "POST", "PUT", "DELETE", "OPTIONS", "PATCH")
# The status of what was not answered: the caller left.
CANCELLED = "CANCELLED"
# What asks every few seconds whether the service lives: at level debug.
_PROBES = ("GET /healthz", "GET /readyz", "GET /metrics")


class Observer:
    """Watches the requests of both doors.

    Args:
        metrics: that count them.
        spans: where they are sent as spans; None for nowhere.
    """

    def __init__(self, metrics: Metrics, spans: Spans | None = None) -> None:
        self.metrics = metrics
        self._spans = spans

    @contextmanager
    def request(
        self, door: str, request_id: str, *, route: str = UNMATCHED, traceparent: str | None = None
    ) -> Iterator[RequestRecord]:
        """Watch a request from its head to the end of its answer.

        The block sets ``status`` of the record when it answers, and ``route`` when that is known.

        Args:
            door: ``http`` or ``grpc``.
            request_id: checked by ``wire.request_id``.
            route: as of ``route_of``, or the name of the gRPC method.
            traceparent: the caller's header, as it came.
        """
        caller = parse_traceparent(traceparent)
        place = None
        if caller is not None:
            place = continued(caller)
        elif self._spans is not None:
            place = started_trace()
        record = RequestRecord(door, request_id, place, route=route)
        begin_request(record)
        self.metrics.request_started(door)
        started, started_ns = perf_counter(), time_ns()
        try:
            yield record
        finally:
            seconds = perf_counter() - started
            record.status = record.status or CANCELLED
            self.metrics.observe_request(door, record.route, record.status, seconds)
            _write(record, seconds)
            if self._spans is not None and place is not None and record.route not in _PROBES:
                end_ns = started_ns + round(seconds * 1e9)
                self._spans.send(
                    RequestSpan(
                        f"{door} {record.route}",
                        place,
                        caller,
                        started_ns,
                        end_ns,
                        _attributes_of(record),
                        record.failed,
                        record.stages,
                    )
                )
            end_request()

    def error(self, error: VislocError) -> None:
        """Note the error that the request in which this runs is answered with."""
        record = current_request()
        if record is not None:
            record.code = error.code
            record.failed = statuses_of(error)[0] >= 500
            self.metrics.observe_error(record.door, error)

    def localization(self, found: Localization) -> None:
        """Note the answer to a photo."""
        self._answer(found)
        record = current_request()
        if record is not None:
            record.stages = stages_until(time_ns(), found.answer.seconds)

    def instant(self, found: Localization) -> None:
        """Note the answer to an instant; a pose that others lent it does not count as its own."""
        self._answer(found)
        record = current_request()
        if record is not None:
            record.instants += 1
            record.localized += found.answer.refusal is None

    def _answer(self, found: Localization) -> None:
        answer = found.answer
        reason = None if answer.refusal is None else answer.refusal.reason.value
        self.metrics.observe_localization(
            found.map_id, reason is None, reason, answer.num_inliers, answer.seconds
        )
        record = current_request()
        if record is not None:
            record.map, record.outcome = found.map_id, reason or LOCALIZED


def route_of(scope: Scope) -> str:
    """Return the method and the template of a request that was served: ``GET /maps/{ref}``."""
    path = getattr(scope.get("route"), "path", None)
    method = scope["method"]
    if path is None or method not in _METHODS:
        return UNMATCHED
    return f"{method} {path}"


def _write(record: RequestRecord, seconds: float) -> None:
    milliseconds = round(seconds * 1000, 1)
    facts: dict[str, object] = {
        "door": record.door,
        "route": record.route,
        "status": record.status,
        "ms": milliseconds,
    }
    if record.instants > 1:
        facts |= {"map": record.map, "instants": record.instants, "localized": record.localized}
    elif record.map is not None:
        facts |= {"map": record.map, "outcome": record.outcome}
    if record.code is not None:
        facts["code"] = record.code
        if record.code.startswith("access."):
            facts["peer"] = record.peer
    level = logging.DEBUG if record.route in _PROBES else logging.INFO
    access_log.log(level, "request", extra={"facts": facts})


def _attributes_of(record: RequestRecord) -> dict[str, str | int | float]:
    attributes: dict[str, str | int | float] = {"visloc.request_id": record.request_id}
    if record.door == "http":
        method, _, path = record.route.rpartition(" ")
        attributes |= {"http.route": path}
        if method:
            attributes["http.request.method"] = method
        if record.status.isdigit():
            attributes["http.response.status_code"] = int(record.status)
    else:
        attributes |= {
            "rpc.system": "grpc",
            "rpc.method": record.route,
            "visloc.grpc.status": record.status,
        }
    for name, value in (
        ("error.type", record.code),
        ("visloc.map", record.map),
        ("visloc.outcome", record.outcome),
    ):
        if value is not None:
            attributes[name] = value
    if record.instants:
        attributes |= {"visloc.instants": record.instants, "visloc.localized": record.localized}
    return attributes
