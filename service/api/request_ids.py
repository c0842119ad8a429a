"""Ids of requests, in answers, logs and traces."""

from __future__ import annotations

import uuid

from visloc_api.words.wire import REQUEST_ID


def request_id(given: str | None) -> str:
    """Return the caller's id when it is short and visible ASCII, else a new one."""
    return given if given and REQUEST_ID.fullmatch(given) else uuid.uuid4().hex
