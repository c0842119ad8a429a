"""Every error a user can meet.

    VislocError
    +- InvalidInput      what was sent or given cannot be used as it is
    |  +- TooLarge       ... because it exceeds a stated limit
    |  +- DatasetError   ... because a file of a dataset is missing or malformed
    |  +- WeightsError   ... because network weights are missing, altered or of another network
    +- NotFound          a map, a file or a record that was named does not exist
    +- Conflict          it exists already, or does not fit what exists
    +- MapCorrupt        a map on disk is not what its manifest says
    +- Unauthenticated   the server needs to know the caller, and cannot
    +- Forbidden         the caller may not do this
    +- Unavailable       the server cannot answer now; trying again later may help
       +- Overloaded     ... because too many requests are waiting
       +- TimedOut       ... because the time that was given to it is over
       +- StorageFull    ... because there is no room on its disk

A photo that cannot be localized is not an error: it is an answer (``visloc.types.NotLocalized``).

``error_codes.toml`` lists the codes with kind and sentence; ``refuse`` makes an error of them.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path


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

    def about(self, field: str | None, kind: type[VislocError] | None = None) -> VislocError:
        """Return the same error about another field, and of another kind where one is given."""
        return (kind or type(self))(
            self.code, self.message, field=field, expected=self.expected, got=self.got
        )


class InvalidInput(VislocError):
    """The input cannot be used as it is."""


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
    """The caller may not do this."""


class Unavailable(VislocError):
    """The server cannot answer now; trying again later may help."""


class Overloaded(Unavailable):
    """Too many requests are waiting."""


class TimedOut(Unavailable):
    """The time that the caller or the server gave to a request is over."""


class StorageFull(Unavailable):
    """There is no room on the server's disk."""


@dataclass(frozen=True, slots=True)
class Entry:
    """The catalogue's entry of a code, or about a family of codes such as ``options.*``.

    Attributes:
        section: who raises it, for the docs.
        kinds: the first is raised unless the place names another one of them.
        sentence: has a ``{name}`` for each value that ``refuse`` takes.
        note: more that the docs tell.
        names: of a family, what stands for the ``*``.
    """

    section: str
    kinds: tuple[type[VislocError], ...]
    sentence: str
    expected: str | None = None
    note: str | None = None
    names: str | None = None


def refuse(
    code: str,
    message: str | None = None,
    *,
    field: str | None = None,
    expected: str | Iterable[str] | None = None,
    got: object = None,
    kind: type[VislocError] | None = None,
    **values: object,
) -> VislocError:
    """Return the error of a code, to be raised.

    Args:
        code: one of the catalogue, or of a family in it.
        message: instead of the catalogue's sentence, where the place knows more.
        expected: what would have been right, or the words to choose from; else the catalogue's.
        kind: instead of the code's first kind.
    """
    entry = _entry(code)
    if expected is None:
        expected = entry.expected
    elif not isinstance(expected, str):
        expected = f"one of {', '.join(expected) or 'none'}"
    text = entry.sentence.format(**values) if message is None else message
    return (kind or entry.kinds[0])(code, text, field=field, expected=expected, got=got)


@functools.cache
def catalogue() -> Mapping[str, Entry]:
    """Return the entries of ``error_codes.toml`` by code, in the order of the file."""
    import tomllib  # only a process that meets an error needs it

    text = Path(__file__).with_name("error_codes.toml").read_text(encoding="utf-8")
    return {
        f"{group}.{name}": _parsed(section, **parts)
        for section, groups in tomllib.loads(text).items()
        for group, names in groups.items()
        for name, parts in names.items()
    }


def _entry(code: str) -> Entry:
    known = catalogue()
    return known[code] if code in known else known[f"{code.partition('.')[0]}.*"]


def _parsed(section: str, *, kind: str | list[str], sentence: str, **rest: str) -> Entry:
    kinds = [kind] if isinstance(kind, str) else kind
    return Entry(section, tuple(globals()[name] for name in kinds), sentence, **rest)


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
    return error.about(field or None)
