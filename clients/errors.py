"""Failures of requests as exceptions of ``visloc.errors``, the same over HTTP and gRPC."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from visloc import errors
from visloc.errors import VislocError, refuse

# By the name that the server sends.
_KINDS = {
    name: value
    for name, value in vars(errors).items()
    if isinstance(value, type) and issubclass(value, VislocError)
}


@dataclass(frozen=True, slots=True)
class Fallback:
    """The exception for a status without our error fields, as proxies send it."""

    kind: type[VislocError]
    code: str


INVALID = Fallback(errors.InvalidInput, "request.invalid")
UNAUTHENTICATED = Fallback(errors.Unauthenticated, "request.unauthenticated")
FORBIDDEN = Fallback(errors.Forbidden, "request.forbidden")
NOT_FOUND = Fallback(errors.NotFound, "request.not_found")
CONFLICT = Fallback(errors.Conflict, "request.conflict")
TOO_LARGE = Fallback(errors.TooLarge, "request.too_large")
OVERLOADED = Fallback(errors.Overloaded, "server.overloaded")
UNAVAILABLE = Fallback(errors.Unavailable, "server.unavailable")
INTERNAL = Fallback(errors.Unavailable, "server.internal")


def received(parts: Mapping[str, object], fallback: Fallback, message: str) -> VislocError:
    """Make the exception that the server describes.

    Args:
        parts: ``kind``, ``code``, ``message``, ``field``, ``expected``, ``got``; any may lack.
        fallback: kind and code when the server names none that is known.
        message: used when ``parts`` has none.
    """
    text = {name: str(value) for name, value in parts.items() if value is not None}
    kind = _KINDS.get(text.get("kind", ""), fallback.kind)
    return kind(
        text.get("code") or fallback.code,
        text.get("message") or message,
        field=text.get("field"),
        expected=text.get("expected"),
        got=text.get("got"),
    )


def unreachable(server: str, why: str) -> VislocError:
    """Make the exception for a server that refuses or drops the connection."""
    if "CERTIFICATE_VERIFY_FAILED" in why:
        return refuse(
            "server.unreachable",
            "the certificate of the server is not trusted; name the authority that "
            "signed it with --ca or ca=",
            field=server,
            got=why,
        )
    return refuse("server.unreachable", field=server, got=why or None)


def timed_out(server: str, timeout_s: float) -> VislocError:
    """Make the exception for an answer that did not come in time."""
    return refuse("server.timeout", field=server, expected=f"an answer within {timeout_s:g} s")


def not_understood(server: str, got: object) -> VislocError:
    """Make the exception for an answer that is not one of a localization service."""
    return refuse("server.answer", field=server, got=got)
