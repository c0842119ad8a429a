"""Every error a user can meet.

    VislocError
    +- InvalidInput      what was sent or given cannot be used as it is
    |  +- TooLarge       ... because it exceeds a stated limit
    |  +- DatasetError   ... because a file of a dataset is missing or malformed
    |  +- WeightsError   ... because network weights are missing, altered or of another network
    +- NotFound          a map, a file or a record that was named does not exist
    +- Conflict          it exists already, or does not fit what exists
    +- MapCorrupt        a map on disk is not what its manifest says
    +- Unauthenticated   the server wants to know who asks, and cannot tell
    +- Forbidden         whoever asks may not do this
    +- Unavailable       the server cannot answer now; trying again later may help
       +- Overloaded     ... because too many requests are waiting
       +- TimedOut       ... because the time that was given to it is over
       +- StorageFull    ... because there is no room on its disk

A photo that cannot be localized is not an error: it is an answer (``visloc.types.NotLocalized``).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class VislocError(Exception):
    """Base of every error that a caller may want to catch.

    Attributes:
        code: a stable word such as ``camera.param_count``; never renamed.
        message: one sentence for a person, without the parts below.
        field: the field, option or file that is wrong, when there is one.
        expected: what would have been right.
        got: what came instead.
    """

    def __init__(
        self,
        code: str,
        message: str,
        *,
        field: str | None = None,
        expected: str | None = None,
        got: object = None,
    ) -> None:
        self.code = code
        self.message = message
        self.field = field
        self.expected = expected
        self.got = None if got is None else _short(got)
        super().__init__(code, message)

    def __str__(self) -> str:
        text = self.message if self.field is None else f"{self.field}: {self.message}"
        details = [
            f"{label} {value}"
            for label, value in (("expected", self.expected), ("got", self.got))
            if value is not None
        ]
        return f"{text} ({', '.join(details)})" if details else text


class InvalidInput(VislocError):
    """What was sent or given cannot be used as it is."""


class TooLarge(InvalidInput):
    """A stated limit on bytes, pixels or counts is exceeded."""


class DatasetError(InvalidInput):
    """A file of a dataset is missing or malformed."""


class WeightsError(InvalidInput):
    """Network weights are missing, altered, or belong to another network."""


class NotFound(VislocError):
    """A map, a file or a record that was named does not exist."""


class Conflict(VislocError):
    """It exists already, or does not fit what exists."""


class MapCorrupt(VislocError):
    """A map on disk is not what its manifest says."""


class Unauthenticated(VislocError):
    """The server wants to know who asks, and cannot tell."""


class Forbidden(VislocError):
    """Whoever asks may not do this."""


class Unavailable(VislocError):
    """The server cannot answer now; trying again later may help."""


class Overloaded(Unavailable):
    """Too many requests are waiting."""


class TimedOut(Unavailable):
    """The time that the caller or the server gave to a request is over."""


class StorageFull(Unavailable):
    """There is no room on the server's disk."""


def _short(value: object, limit: int = 200) -> str:
    text = value if isinstance(value, str) else repr(value)
    return text if len(text) <= limit else text[: limit - 3] + "..."


@contextmanager
def inside(place: str) -> Iterator[None]:
    """Prefix the fields of errors in the block: ``camera.width`` becomes ``PLACE.camera.width``."""
    try:
        yield
    except VislocError as error:
        raise placed(error, place) from None


def placed(error: VislocError, place: str) -> VislocError:
    """Return the error of a field within a larger message."""
    field = ".".join(part for part in (place, error.field) if part)
    return type(error)(
        error.code, error.message, field=field or None, expected=error.expected, got=error.got
    )
