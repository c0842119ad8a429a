from __future__ import annotations

import asyncio
import logging
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families

from service.telemetry.logs import current_request, note_key
from service.telemetry.metrics import Metrics, ServiceState
from service.telemetry.observer import Observer
from service.telemetry.tracing import RequestSpan, parse_traceparent
from service.values import Localization
from visloc.errors import InvalidInput, VislocError
from visloc.geometry import Camera, Pose
from visloc.options import ReadAs
from visloc.types import (
    CameraSource,
    Evidence,
    ImageAnswer,
    InstantAnswer,
    PoseSource,
    Reason,
    Refusal,
    RigPose,
    Uncertainty,
)

TRACE, SPAN = "0af7651916cd43dd8448eb211c80319c", "b7ad6b7169203331"
TRACEPARENT = f"00-{TRACE}-{SPAN}-01"

EVIDENCE = Evidence(
    Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0)),
    CameraSource.GIVEN,
    1,
    ReadAs.STORED,
    num_inliers=80,
)
POSE = Pose.from_quaternion((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
IMAGE = ImageAnswer("camera", Pose.identity(), EVIDENCE, None)
RIG_POSE = RigPose(
    *(POSE, np.eye(6), np.ones(3), np.ones(3), PoseSource.ESTIMATED),
    *(np.eye(6), Uncertainty.WHOLE),
)
YES = Localization(
    InstantAnswer(None, (IMAGE,), RIG_POSE, None, {"queued": 0.25, "pose": 0.5}), "hall", "1"
)
REFUSAL = Refusal("pose", Reason.NO_POSE, "no pose")
NO = replace(YES, answer=replace(YES.answer, pose=None, refusal=REFUSAL))


def instant(refusal: Refusal | None) -> Localization:
    return Localization(InstantAnswer(1, (), None, refusal, {"pose": 0.1}), "hall", "1")


class KeptSpans:
    """Keeps spans instead of sending them."""

    def __init__(self) -> None:
        self.sent: list[RequestSpan] = []

    def send(self, span: RequestSpan) -> None:
        self.sent.append(span)


def counted(observer: Observer, name: str) -> dict[frozenset[tuple[str, str]], float]:
    text = observer.metrics.render(ServiceState(ready=True))[0].decode()
    return {
        frozenset(sample.labels.items()): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
        if sample.name == name and sample.value
    }


def access_lines(caplog: pytest.LogCaptureFixture) -> list[dict[str, Any]]:
    return [vars(r)["facts"] for r in caplog.records if r.name == "service.access"]


@pytest.fixture(autouse=True)
def _heard(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "service.access")


def test_a_request_is_counted_logged_and_told_as_a_span(caplog: pytest.LogCaptureFixture) -> None:
    spans = KeptSpans()
    observer = Observer(Metrics(), spans)  # type: ignore[arg-type]

    with observer.request("http", "abc", traceparent=TRACEPARENT) as record:
        assert current_request() is record
        observer.localization(YES)
        record.route, record.status = "POST /localize", "200"

    assert current_request() is None
    request = {("door", "http"), ("route", "POST /localize")}
    assert counted(observer, "visloc_requests_total") == {
        frozenset({*request, ("status", "200")}): 1
    }
    (line,) = access_lines(caplog)
    assert line.pop("ms") >= 0
    assert line == {
        "door": "http",
        "route": "POST /localize",
        "status": "200",
        "map": "hall",
        "outcome": "localized",
    }
    (span,) = spans.sent
    assert span.name == "http POST /localize"
    assert span.caller == parse_traceparent(TRACEPARENT)
    assert span.context == record.trace
    assert span.context.trace_id == int(TRACE, 16)
    assert span.attributes["http.route"] == "/localize"
    assert span.attributes["http.response.status_code"] == 200
    assert span.attributes["visloc.map"] == "hall"
    assert [stage.name for stage in span.stages] == ["queued", "pose"]
    assert not span.failed


def test_without_a_trace_there_is_none_and_with_a_collector_one_is_started() -> None:
    with Observer(Metrics()).request("http", "abc") as record:
        assert record.trace is None
    with Observer(Metrics(), KeptSpans()).request("http", "abc") as record:  # type: ignore[arg-type]
        assert record.trace is not None
    with Observer(Metrics()).request("http", "abc", traceparent=TRACEPARENT) as record:
        assert record.trace is not None
        assert record.trace.trace_id == int(TRACE, 16)
        assert record.trace.span_id != int(SPAN, 16)


def test_a_refusal_is_counted_by_its_code_and_is_not_the_servers_fault(
    caplog: pytest.LogCaptureFixture,
) -> None:
    spans = KeptSpans()
    observer = Observer(Metrics(), spans)  # type: ignore[arg-type]

    with observer.request("grpc", "abc", route="Localize") as record:
        observer.error(InvalidInput("image.empty", "no photo"))
        record.status = "INVALID_ARGUMENT"
    with observer.request("grpc", "abc", route="Localize"):
        observer.error(VislocError("server.internal", "a mistake"))

    assert counted(observer, "visloc_errors_total") == {
        frozenset({("door", "grpc"), ("code", code), ("kind", kind)}): 1
        for code, kind in (("image.empty", "InvalidInput"), ("server.internal", "VislocError"))
    }
    assert [line["code"] for line in access_lines(caplog)] == ["image.empty", "server.internal"]
    assert [span.failed for span in spans.sent] == [False, True]
    assert spans.sent[0].attributes["error.type"] == "image.empty"
    assert spans.sent[0].attributes["rpc.method"] == "Localize"


def test_a_caller_that_leaves_is_counted_as_such(caplog: pytest.LogCaptureFixture) -> None:
    observer = Observer(Metrics())

    with (
        pytest.raises(asyncio.CancelledError),
        observer.request("http", "abc", route="POST /localize"),
    ):
        raise asyncio.CancelledError

    (line,) = access_lines(caplog)
    assert line["status"] == "CANCELLED"
    assert counted(observer, "visloc_requests_in_progress") == {}


def test_instants_that_others_lend_a_pose_are_not_localized(
    caplog: pytest.LogCaptureFixture,
) -> None:
    observer = Observer(Metrics())

    with observer.request("http", "abc"):
        observer.instant(instant(None))
        observer.instant(instant(Refusal("pose", Reason.NO_POSE, "no pose")))
        observer.instant(instant(None))

    assert counted(observer, "visloc_localizations_total") == {
        frozenset({("map", "hall"), ("outcome", "localized")}): 2,
        frozenset({("map", "hall"), ("outcome", "no_pose")}): 1,
    }
    (line,) = access_lines(caplog)
    assert (line["instants"], line["localized"]) == (3, 2)


def test_answers_outside_of_a_request_are_counted_too() -> None:
    observer = Observer(Metrics())

    observer.localization(NO)
    observer.error(InvalidInput("image.empty", "no photo"))  # nobody was told

    assert counted(observer, "visloc_localizations_total") == {
        frozenset({("map", "hall"), ("outcome", "no_pose")}): 1
    }
    assert counted(observer, "visloc_errors_total") == {}


def test_requests_at_the_same_time_do_not_mix(caplog: pytest.LogCaptureFixture) -> None:
    observer = Observer(Metrics())

    async def serve(key: str, found: Localization) -> None:
        with observer.request("http", key) as record:
            note_key(key)
            await asyncio.sleep(0.01)
            # As the doors do it: the work runs in a task, and parts of it in threads.
            await asyncio.create_task(asyncio.to_thread(observer.localization, found))
            await asyncio.sleep(0.01)
            assert record.key == key
            record.status = "200"

    async def serve_both() -> None:
        await asyncio.gather(serve("a", YES), serve("b", NO))
        assert current_request() is None

    asyncio.run(serve_both())

    assert sorted(line["outcome"] for line in access_lines(caplog)) == ["localized", "no_pose"]


def test_probes_are_not_logged_and_no_spans(caplog: pytest.LogCaptureFixture) -> None:
    spans = KeptSpans()
    observer = Observer(Metrics(), spans)  # type: ignore[arg-type]

    with observer.request("http", "abc") as record:
        record.route, record.status = "GET /readyz", "200"

    assert access_lines(caplog) == []
    assert spans.sent == []
    assert len(counted(observer, "visloc_requests_total")) == 1
