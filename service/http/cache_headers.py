"""Headers of caching and compression (RFC 9110, RFC 9111)."""

from __future__ import annotations

import re

from starlette.datastructures import Headers
from starlette.responses import Response

# A year, the longest that caches respect.
_FOR_EVER = "max-age=31536000, immutable"
FOR_EVER, FOR_EVER_PRIVATE = f"public, {_FOR_EVER}", f"private, {_FOR_EVER}"
ASK_ALWAYS, ASK_ALWAYS_PRIVATE = "no-cache", "private, no-cache"

_TAG = re.compile(r'(?:W/)?("[^"]*")')


def is_current(request: Headers, etag: str) -> bool:
    """Tell whether the client already has the content that ``etag`` names."""
    given = ",".join(request.getlist("if-none-match"))
    return given.strip() == "*" or etag in _TAG.findall(given)


def not_modified(headers: dict[str, str]) -> Response:
    """Answer 304, with the headers that the full answer would have."""
    return Response(status_code=304, headers=headers)


def takes_gzip(request: Headers) -> bool:
    """Tell whether the client accepts gzip."""
    for item in ",".join(request.getlist("accept-encoding")).lower().split(","):
        name, _, quality = item.partition(";")
        if name.strip() in ("gzip", "x-gzip"):
            return re.fullmatch(r"q=0(\.0*)?", quality.strip().replace(" ", "")) is None
    return False
