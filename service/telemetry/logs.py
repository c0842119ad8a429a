"""Log lines for people or machines, and the record of the request that they belong to.

Images and keys are not logged. Callers cannot forge lines: control characters are escaped, and the
lines of a traceback are marked.
"""

from __future__ import annotations

import json
import logging
import re
import sys
from collections.abc import Mapping
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from opentelemetry.trace import SpanContext

    from service.telemetry.tracing import Stage

# The route of requests that match none: their paths are the caller's words.
UNMATCHED = "unmatched"


@dataclass(slots=True)
class RequestRecord:
    """The facts about a request, gathered as it proceeds and logged when it ends.

    Attributes:
        request_id: the caller's if it was acceptable, else ours.
        trace: its span in the caller's trace, if there is one.
        key: the name of the API key.
        peer: the caller's address; logged only when access is refused.
        route: the method and the template of the path, or the name of the gRPC method.
        status: of the answer, such as ``200`` or ``OK``; empty until there is one.
        map: the id of the map that answered.
        outcome: ``localized``, or the reason why not; of several instants, that of the last.
        localized: how many of these were localized.
        code: of the error that was answered.
        failed: whether that error was the server's fault.
    """

    door: str
    request_id: str
    trace: SpanContext | None = None
    key: str | None = None
    peer: str | None = None
    route: str = UNMATCHED
    status: str = ""
    map: str | None = None
    outcome: str | None = None
    instants: int = 0
    localized: int = 0
    code: str | None = None
    failed: bool = False
    stages: tuple[Stage, ...] = ()


_request: ContextVar[RequestRecord | None] = ContextVar("request", default=None)
_key: ContextVar[str | None] = ContextVar("key", default=None)


def current_request() -> RequestRecord | None:
    """Return the request that the current task serves, if any."""
    return _request.get()


def note_key(name: str) -> None:
    """Record the name of the API key of the current request."""
    record = _request.get()
    if record is None:
        _key.set(name)  # gRPC's interceptors run first, in the task that then serves the call
    else:
        record.key = name


def begin_request(record: RequestRecord) -> None:
    """Make this the record of the current task and of the tasks that it starts."""
    record.key = record.key or _key.get()
    _key.set(None)
    _request.set(record)


def end_request() -> None:
    """Detach the current task from its request."""
    _request.set(None)


class LogSettings(Protocol):
    """How the service and its worker processes log."""

    @property
    def log_level(self) -> str:
        """``debug``, ``info``, ``warning`` or ``error``."""

    @property
    def log_format(self) -> str:
        """``text`` or ``json``."""


def configure_logging(settings: LogSettings) -> None:
    """Log to stderr. Called once in ``main`` and first in every worker process.

    Libraries log from WARNING up, because below it some of them log credentials.
    """
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter() if settings.log_format == "json" else TextFormatter())
    level = logging.getLevelNamesMapping()[settings.log_level.upper()]
    root = logging.getLogger()
    for old in root.handlers[:]:
        root.removeHandler(old)
    root.addHandler(handler)
    root.setLevel(max(level, logging.WARNING))
    for name in ("service", "visloc"):
        logging.getLogger(name).setLevel(level)
    logging.getLogger("python_multipart").setLevel(logging.ERROR)  # malformed forms are answered
    # It warns of every span that it drops, and of callers' malformed headers.
    logging.getLogger("opentelemetry").setLevel(logging.ERROR)
    logging.captureWarnings(True)


class TextFormatter(logging.Formatter):
    """One line per record: time, level, logger, message, then ``name=value`` pairs."""

    def format(self, record: logging.LogRecord) -> str:
        facts = " ".join(f"{name}={_word(value)}" for name, value in _facts_of(record).items())
        line = " ".join(
            (_time_of(record), record.levelname, record.name + ":", one_line(record.getMessage()))
        )
        trace = "".join(f"\n    | {one_line(part)}" for part in _traceback_of(self, record))
        return _hidden(f"{line} {facts}".rstrip() + trace)


class JsonFormatter(logging.Formatter):
    """One JSON object per line."""

    def format(self, record: logging.LogRecord) -> str:
        entry: dict[str, object] = {
            "time": _time_of(record),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **_facts_of(record),
        }
        if traceback := _traceback_of(self, record):
            entry["traceback"] = "\n".join(traceback)
        return _hidden(json.dumps(entry, default=str))  # ASCII: nothing in it can break the line


def one_line(text: str) -> str:
    """Escape characters that end a line, control a terminal or change the text direction."""
    return _UNPRINTABLE.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


# ASCII and Latin-1 controls, line and paragraph separators, direction marks, surrogates.
_UNPRINTABLE = re.compile(
    r"[\x00-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff\ufeff]"
)
# An API key as `python -m service.keys` prints it. The service logs none; a library may put a
# request's headers into an exception.
_API_KEY = re.compile(r"(visloc_[A-Za-z0-9-]+_)[A-Za-z0-9_-]{32,}")


def _hidden(text: str) -> str:
    return _API_KEY.sub(r"\1***", text)


def _word(value: object) -> str:
    text = one_line(str(value))
    return json.dumps(text) if not text or re.search(r'[\s"=]', text) else text


def _time_of(record: logging.LogRecord) -> str:
    moment = datetime.fromtimestamp(record.created, UTC)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _traceback_of(formatter: logging.Formatter, record: logging.LogRecord) -> list[str]:
    parts = []
    if record.exc_info:
        parts.append(formatter.formatException(record.exc_info))
    if record.stack_info:
        parts.append(record.stack_info)
    return [line for part in parts for line in part.split("\n")]


def _facts_of(record: logging.LogRecord) -> Mapping[str, object]:
    """Return the ``facts`` given to the log call, and the ids of the current request."""
    facts = dict(getattr(record, "facts", {}))
    request = _request.get()
    if request is not None:
        facts["request_id"] = request.request_id
        if request.trace is not None:
            facts["trace_id"] = f"{request.trace.trace_id:032x}"
        if request.key is not None:
            facts["key"] = request.key
    return facts
