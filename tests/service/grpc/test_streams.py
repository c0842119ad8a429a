"""Answers that come as they become final: order, errors on the way, back-pressure, hanging up.

The engine's own work is replaced here; see test_batches.py for the real one.
"""

from __future__ import annotations

import asyncio
import json
import logging
import queue
import socket
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import grpc
import httpx
import pytest
from google.rpc.error_details_pb2 import ErrorInfo
from grpc_status import rpc_status

from service.values import InstantJob, Localization, SequenceJob
from visloc.errors import InvalidInput
from visloc.types import InstantAnswer, Reason, Refusal
from visloc_api.v1 import localization_pb2 as pb2
from visloc_api.words.answers import LocalizeSequenceResponse

LINES = {"Accept": "application/x-ndjson"}


@dataclass
class Pretender:
    """An engine whose answers are empty: one per instant, as soon as it is there.

    Attributes:
        gate: answers after the first wait for it.
        fail_at: the instant at which ``error`` is raised.
        message: of every answer's refusal, to make it large.
        taken: instants that were asked for so far.
        ended: set when the work is over or was dropped.
    """

    gate: threading.Event = field(default_factory=threading.Event)
    fail_at: int | None = None
    error: Exception = field(default_factory=lambda: InvalidInput("sequence.timestamps", "back"))
    message: str = ""
    taken: int = 0
    ended: threading.Event = field(default_factory=threading.Event)

    async def localize_sequence(
        self, start: SequenceJob, instants: AsyncIterator[InstantJob] | Sequence[InstantJob]
    ) -> AsyncIterator[Localization]:
        """Stand in for the engine's."""
        try:
            async for instant in one_by_one(instants):
                if self.taken == self.fail_at:
                    raise self.error
                while self.taken and not self.gate.is_set():
                    await asyncio.sleep(0.01)
                self.taken += 1
                refusal = Refusal("features", Reason.NO_USABLE_IMAGE, self.message)
                answer = InstantAnswer(instant.timestamp, (), None, refusal, {})
                yield Localization(answer, start.maps[0], "1")
        finally:
            self.ended.set()


async def one_by_one(
    instants: AsyncIterator[InstantJob] | Sequence[InstantJob],
) -> AsyncIterator[InstantJob]:
    if isinstance(instants, Sequence):
        for instant in instants:
            yield instant
    else:
        async for instant in instants:
            yield instant


@pytest.fixture
def pretend(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Pretender]:
    """Replace the engine's work behind some doors."""

    def replace(doors: Any, *, gate: bool = True, **changes: Any) -> Pretender:
        pretender = Pretender(**changes)
        if gate:
            pretender.gate.set()
        engine = doors.server.engine
        monkeypatch.setattr(engine, "localize_sequence", pretender.localize_sequence)
        return pretender

    return replace


@pytest.fixture(scope="module")
def running(serve: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A service without maps that takes one sequence at a time."""
    maps = tmp_path_factory.mktemp("maps")
    with serve(maps, max_batches=1, max_batch_bytes=1_000_000) as doors:
        yield doors


@pytest.fixture
def one(running: Any) -> Iterator[Any]:
    """The same, whose place is free."""
    yield running
    until(lambda: running.server.engine.batches == 0)


def body(num: int) -> dict[str, Any]:
    instants = [{"timestamp": i, "images": [{"image": ""}]} for i in range(num)]
    return {"map": "room", "instants": instants}


def post(doors: Any, num: int, **headers: str) -> httpx.Response:
    response: httpx.Response = doors.http.post(
        "/localize/sequence", json=body(num), headers=headers
    )
    return response


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


# HTTP


def test_answers_come_in_order_as_one_json_or_as_lines(one: Any, pretend: Any) -> None:
    pretend(one)
    whole = post(one, 3, **{"X-Request-Id": "run-1"})
    lines = post(one, 3, **{"X-Request-Id": "run-1"}, **LINES)

    assert whole.headers["content-type"] == "application/json"
    LocalizeSequenceResponse.model_validate_json(whole.content)
    answers = whole.json()["answers"]
    assert [answer["timestamp"] for answer in answers] == [0, 1, 2]
    assert whole.json()["request_id"] == answers[0]["request_id"] == "run-1"
    assert lines.headers["content-type"] == "application/x-ndjson"
    assert [json.loads(line) for line in lines.text.splitlines()] == answers


@pytest.mark.parametrize(
    ("accept", "as_lines"),
    [
        ("application/json, application/x-ndjson;q=0.9", True),
        ("Application/X-NDJSON", True),
        ("*/*", False),
        ("application/x-ndjson-seq", False),
    ],
)
def test_lines_are_sent_to_those_who_accept_them(
    accept: str, as_lines: bool, one: Any, pretend: Any
) -> None:
    pretend(one)
    kind = post(one, 1, Accept=accept).headers["content-type"]
    assert (kind == "application/x-ndjson") == as_lines


def test_a_line_is_sent_as_soon_as_its_answer_is_final(one: Any, pretend: Any) -> None:
    pretender = pretend(one, gate=False)
    with one.http.stream("POST", "/localize/sequence", json=body(3), headers=LINES) as response:
        lines = response.iter_lines()
        assert json.loads(next(lines))["timestamp"] == 0
        assert not pretender.ended.is_set()
        pretender.gate.set()
        assert [json.loads(line)["timestamp"] for line in lines] == [1, 2]


def test_an_error_before_the_first_line_is_a_problem(one: Any, pretend: Any) -> None:
    for headers in ({}, LINES):
        pretend(one, fail_at=0)
        response = post(one, 2, **headers)
        assert response.status_code == 422
        assert response.headers["content-type"] == "application/problem+json"
        assert response.json()["code"] == "sequence.timestamps"


def test_an_error_after_the_first_line_is_the_last_line(one: Any, pretend: Any) -> None:
    pretend(one, fail_at=2)
    first, second, last = post(one, 9, **LINES).text.splitlines()

    assert [json.loads(line)["timestamp"] for line in (first, second)] == [0, 1]
    problem = json.loads(last)["problem"]
    assert (problem["status"], problem["code"]) == (422, "sequence.timestamps")
    assert problem["request_id"] == json.loads(first)["request_id"]
    pretend(one, fail_at=2)
    assert post(one, 9).json()["code"] == "sequence.timestamps"


def test_what_breaks_after_the_first_line_is_told_without_its_insides(
    one: Any, pretend: Any, caplog: pytest.LogCaptureFixture
) -> None:
    pretend(one, fail_at=1, error=ZeroDivisionError("inside"))
    _, last = post(one, 2, **LINES).text.splitlines()

    assert json.loads(last)["problem"]["code"] == "server.internal"
    assert "inside" not in last
    assert "ZeroDivisionError" in caplog.text


@pytest.mark.parametrize("headers", [{}, LINES], ids=["json", "lines"])
def test_a_client_that_hangs_up_ends_the_work_and_frees_its_place(
    headers: dict[str, str], one: Any, pretend: Any, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    pretender = pretend(one, gate=False)
    with (
        pytest.raises(httpx.ReadTimeout),
        httpx.stream(
            *("POST", f"{one.url}/localize/sequence"),
            json=body(3),
            headers=headers,
            timeout=httpx.Timeout(10, read=0.3),
        ) as response,
    ):
        response.read()
    assert pretender.ended.wait(20)
    until(
        lambda: (
            any(
                getattr(record, "facts", {}).get("status") == "CANCELLED"
                for record in caplog.records
            )
            or "left within the answer" in caplog.text
        )
    )
    pretend(one)
    assert post(one, 1).status_code == 200


def test_a_client_that_reads_no_lines_is_not_worked_for(one: Any, pretend: Any) -> None:
    pretender = pretend(one, message="x" * 100_000)
    content = json.dumps(body(900)).encode()
    head = (
        "POST /localize/sequence HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
        f"Accept: application/x-ndjson\r\nContent-Length: {len(content)}\r\n\r\n"
    )
    with socket.socket() as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
        connection.connect(("127.0.0.1", one.server.http_port))
        connection.sendall(head.encode() + content)
        assert stalled(pretender) < 300
    assert pretender.ended.wait(20)


def stalled(pretender: Pretender) -> int:
    """Wait until no more instants are taken, and return how many were."""
    before = -1
    until(lambda: pretender.taken > 0)
    while pretender.taken != before:
        before = pretender.taken
        time.sleep(0.5)
    return before


def test_one_more_sequence_is_refused_when_it_has_come(one: Any, pretend: Any) -> None:
    pretender = pretend(one, gate=False)
    with one.http.stream("POST", "/localize/sequence", json=body(2), headers=LINES) as response:
        lines = response.iter_lines()
        next(lines)
        rig = {"map": "room", "rig": "rig", "images": [{"sensor": "left", "image": ""}]}
        for refused in (post(one, 1), one.http.post("/localize/rig", json=rig)):
            assert refused.status_code == 429
            assert (refused.json()["code"], refused.headers["retry-after"]) == ("server.busy", "1")
        pretender.gate.set()
        assert len(list(lines)) == 1
    until(lambda: post(one, 1).status_code == 200)  # the place is free a moment after the last line


def test_sequences_that_do_not_come_hold_no_place(one: Any, pretend: Any) -> None:
    pretend(one)
    head = (
        "POST /localize/sequence HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9\r\n"
        "Content-Type: application/json\r\n\r\n"
    )
    with socket.create_connection(("127.0.0.1", one.server.http_port)) as connection:
        connection.sendall(head.encode())
        assert post(one, 1).status_code == 200


# gRPC


def messages(num: int, photo: bytes = b"") -> Iterator[pb2.LocalizeSequenceRequest]:
    yield pb2.LocalizeSequenceRequest(start=pb2.SequenceStart(map="room", request_id="run-2"))
    for timestamp in range(num):
        yield instant(timestamp, photo)


def instant(timestamp: int, photo: bytes = b"") -> pb2.LocalizeSequenceRequest:
    image = pb2.RigImage(image=photo)
    return pb2.LocalizeSequenceRequest(instant=pb2.Instant(timestamp=timestamp, images=[image]))


def reason_of(call: Any) -> ErrorInfo:
    """Take answers until an error comes, and return its details."""
    with pytest.raises(grpc.RpcError) as caught:
        list(call)
    details, info = rpc_status.from_call(caught.value), ErrorInfo()
    assert details is not None
    assert details.details[0].Unpack(info)
    return info


def test_a_stream_is_answered_while_it_is_sent(one: Any, pretend: Any) -> None:
    pretend(one)
    sending: queue.SimpleQueue[Any] = queue.SimpleQueue()
    sending.put(next(messages(0)))
    call = one.stub.LocalizeSequence(iter(sending.get, None))
    for timestamp in range(3):
        sending.put(instant(timestamp))
        answer = next(call)
        assert (answer.timestamp, answer.request_id) == (timestamp, "run-2")
    sending.put(None)
    assert list(call) == []


def test_a_stream_whose_answers_are_not_taken_is_not_read(one: Any, pretend: Any) -> None:
    pretender = pretend(one, message="x" * 100_000)
    sent = 0

    def counted() -> Iterator[pb2.LocalizeSequenceRequest]:
        nonlocal sent
        for message in messages(400, bytes(100_000)):
            sent += 1
            yield message

    call = one.stub.LocalizeSequence(counted())

    assert stalled(pretender) < 60
    assert sent < 300  # gRPC widens a connection's window to as much as 16 MiB, 167 of these
    assert [answer.timestamp for answer in call] == list(range(400))


def test_a_call_that_is_cancelled_ends_the_work_and_frees_its_place(one: Any, pretend: Any) -> None:
    pretender = pretend(one, gate=False)
    call = one.stub.LocalizeSequence(messages(5))
    assert next(call).timestamp == 0
    busy = reason_of(one.stub.LocalizeSequence(messages(1)))
    call.cancel()

    assert (busy.reason, busy.metadata["kind"]) == ("server.busy", "Overloaded")
    assert pretender.ended.wait(20)
    pretend(one)
    until(lambda: _is_served(one))


def _is_served(doors: Any) -> bool:
    try:
        return len(list(doors.stub.LocalizeSequence(messages(1)))) == 1
    except grpc.RpcError:
        return False


def test_a_cancelled_call_whose_answers_were_not_taken_frees_its_place_too(
    one: Any, pretend: Any
) -> None:
    pretender = pretend(one, message="x" * 100_000)
    call = one.stub.LocalizeSequence(messages(500))
    stalled(pretender)
    call.cancel()

    assert pretender.ended.wait(20)
    pretend(one)
    until(lambda: _is_served(one))


def test_an_error_after_some_answers_ends_the_call(one: Any, pretend: Any) -> None:
    pretend(one, fail_at=2)
    call = one.stub.LocalizeSequence(messages(9))

    assert [next(call).timestamp for _ in range(2)] == [0, 1]
    info = reason_of(call)
    assert (info.reason, info.metadata["request_id"]) == ("sequence.timestamps", "run-2")


def test_a_stream_is_a_start_and_then_instants(one: Any, pretend: Any) -> None:
    start = next(messages(0))
    for sent, got in (
        ([], "nothing"),
        ([instant(0)], "instant"),
        ([start, instant(0), start], "start"),
        ([start, pb2.LocalizeSequenceRequest()], "nothing"),
    ):
        pretend(one)
        info = reason_of(one.stub.LocalizeSequence(iter(sent)))
        assert (info.reason, info.metadata["got"]) == ("sequence.message", got)


def test_before_the_maps_are_loaded_nothing_is_taken(serve: Any, tmp_path: Any) -> None:
    with serve(tmp_path, load=False) as doors:
        assert post(doors, 1).json()["code"] == "server.starting"
        info = reason_of(doors.stub.LocalizeSequence(messages(1)))
        assert info.reason == "server.starting"


def test_a_message_for_one_photo_has_the_limit_of_one_photo(serve: Any, tmp_path: Any) -> None:
    with serve(tmp_path, max_image_bytes=1000) as doors:
        with pytest.raises(grpc.RpcError) as caught:
            doors.stub.Localize(pb2.LocalizeRequest(map="room", image=bytes(100_000)))
        call: Any = caught.value
        assert call.code() == grpc.StatusCode.RESOURCE_EXHAUSTED
        assert "request has too many bytes" in call.details()
