from __future__ import annotations

import io
import json
import logging
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.settings import ServiceSettings
from service.telemetry.logs import (
    JsonFormatter,
    RequestRecord,
    TextFormatter,
    begin_request,
    configure_logging,
    current_request,
    end_request,
    note_key,
    one_line,
)
from service.telemetry.tracing import parse_traceparent

SECRET = "visloc_7f3a_" + "Zk3-_9" * 8


def record_of(message: str, *arguments: object, **extra: object) -> logging.LogRecord:
    record = logging.LogRecord("service.x", logging.INFO, "", 0, message, arguments, None)
    vars(record).update(extra)
    return record


@contextmanager
def logging_as(format_: Literal["text", "json"], level: str = "info") -> Iterator[io.StringIO]:
    """Logging as a service does it, into a string; and as it was, afterwards."""
    root, names = (
        logging.getLogger(),
        ("", "service", "visloc", "python_multipart", "opentelemetry"),
    )
    levels = {name: logging.getLogger(name).level for name in names}
    handlers, stderr, sys.stderr = root.handlers[:], sys.stderr, io.StringIO()
    try:
        configure_logging(ServiceSettings(log_format=format_, log_level=level))
        yield sys.stderr
    finally:
        sys.stderr, root.handlers[:] = stderr, handlers
        logging.captureWarnings(False)
        for name, old in levels.items():
            logging.getLogger(name).setLevel(old)


@pytest.fixture
def in_request() -> Iterator[None]:
    trace = parse_traceparent(f"00-{'1' * 32}-{'2' * 16}-01")
    begin_request(RequestRecord("http", "abc", trace, key="robot 7"))
    yield
    end_request()


@pytest.mark.usefixtures("in_request")
def test_a_line_of_text_says_when_what_and_of_which_request() -> None:
    line = TextFormatter().format(record_of("opened %s", "hall", facts={"ms": 1.5}))

    assert re.fullmatch(
        r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z INFO service\.x: opened hall "
        r'ms=1\.5 request_id=abc trace_id=1{32} key="robot 7"',
        line,
    )


@pytest.mark.usefixtures("in_request")
def test_a_line_of_json_says_the_same() -> None:
    entry = json.loads(JsonFormatter().format(record_of("opened %s", "hall", facts={"ms": 1.5})))

    assert re.fullmatch(r"[\d-]{10}T[\d:.]{12}Z", entry.pop("time"))
    assert entry == {
        "level": "info",
        "logger": "service.x",
        "message": "opened hall",
        "ms": 1.5,
        "request_id": "abc",
        "trace_id": "1" * 32,
        "key": "robot 7",
    }


def test_outside_of_a_request_nothing_is_said_of_one() -> None:
    assert current_request() is None
    assert TextFormatter().format(record_of("ready")).endswith("service.x: ready")


HOSTILE = "x\n2026-01-01T00:00:00.000Z INFO service: forged\r\x1b[2J\x00\u2028\u202e\x85\ud800"


@pytest.mark.parametrize(
    "record",
    [
        record_of(HOSTILE),
        record_of("%s", HOSTILE),
        record_of("a", facts={"got": HOSTILE}),
        record_of("a", facts={HOSTILE.encode("unicode_escape").decode(): HOSTILE}),
    ],
)
def test_nobody_forges_a_line(record: logging.LogRecord) -> None:
    line = TextFormatter().format(record)
    assert line.isprintable()
    assert len(line.splitlines()) == 1

    entry = JsonFormatter().format(record)
    assert entry.isascii()
    assert entry.isprintable()
    json.loads(entry)


@given(st.text())
def test_no_text_leaves_its_line(text: str) -> None:
    line = one_line(text)

    assert len(line.splitlines()) <= 1
    line.encode()


def failure(text: str) -> logging.LogRecord:
    record = record_of("request broke")
    try:
        int(text)
    except ValueError as error:
        record.exc_info = (ValueError, ValueError(text), error.__traceback__)
    return record


def test_the_lines_of_a_traceback_cannot_be_taken_for_others() -> None:
    first, *more = TextFormatter().format(failure(HOSTILE)).splitlines()

    assert first.endswith("service.x: request broke")
    assert len(more) >= 3
    for line in more:
        assert line.startswith("    | ")
        assert line.isprintable()


def test_a_traceback_in_json_is_text() -> None:
    entry = json.loads(JsonFormatter().format(failure("no")))

    assert entry["traceback"].startswith("Traceback (most recent call last):\n")
    assert entry["traceback"].endswith("ValueError: no")


@pytest.mark.parametrize("formatter", [TextFormatter(), JsonFormatter()])
@pytest.mark.parametrize(
    "make",
    [
        lambda: record_of("refused %r", {"authorization": f"Bearer {SECRET}"}),
        lambda: record_of("a", facts={"got": SECRET}),
        lambda: failure(f"headers: {SECRET}"),
    ],
    ids=["message", "facts", "traceback"],
)
def test_a_key_that_slips_into_a_message_is_not_written(
    formatter: logging.Formatter, make: Callable[[], logging.LogRecord]
) -> None:
    line = formatter.format(make())

    assert "visloc_7f3a_***" in line
    assert SECRET not in line
    assert SECRET[-20:] not in line


def test_a_key_is_noted_by_name_before_or_while_the_request_is_recorded() -> None:
    note_key("before")
    begin_request(before := RequestRecord("grpc", "1"))
    begin_request(other := RequestRecord("http", "2"))
    note_key("while")
    end_request()

    assert (before.key, other.key) == ("before", "while")


def test_the_settings_choose_format_and_level() -> None:
    with logging_as("json") as written:
        logging.getLogger("service.engine.engine").info("%d photos", 3)
        logging.getLogger("service.engine.engine").debug("not this")
        logging.getLogger("visloc").warning("that")
    assert [json.loads(line)["message"] for line in written.getvalue().splitlines()] == [
        "3 photos",
        "that",
    ]

    with logging_as("text", "debug") as written:
        logging.getLogger("service.engine.engine").debug("this too")
    assert written.getvalue().endswith("DEBUG service.engine.engine: this too\n")


def test_libraries_are_not_asked_for_details_which_may_contain_credentials() -> None:
    with logging_as("text", "debug") as written:
        logging.getLogger("botocore.auth").debug("StringToSign: secret")
        logging.getLogger("botocore.auth").info("secret")
        logging.getLogger("botocore.auth").warning("no answer")

    assert "secret" not in written.getvalue()
    assert "no answer" in written.getvalue()
