"""Ids of requests, in answers, logs and traces."""

from __future__ import annotations

import re
import uuid

_REQUEST_ID = re.compile(r"[\x21-\x7e]{1,128}")


def request_id(given: str | None) -> str:
    """Return the caller's id when it is short and visible ASCII, else a new one."""
    return given if given and _REQUEST_ID.fullmatch(given) else uuid.uuid4().hex
