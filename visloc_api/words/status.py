"""Health, readiness and errors."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from visloc_api.words.base import Answer


class Health(Answer):
    """The process answers."""

    status: Literal["ok"] = "ok"
    version: str


class MapNotLoaded(Answer):
    """A map that is on disk and cannot be served."""

    id: str
    code: str
    message: str


class Readiness(Answer):
    """Whether photos are accepted."""

    ready: Annotated[bool, Field(description="whether the maps to open at start are open and warm")]
    maps: Annotated[
        list[str], Field(description="id@version of what is loaded; empty without the scope read")
    ]
    not_loaded: Annotated[
        list[MapNotLoaded],
        Field(
            description="maps that cannot be served; the server can be ready without them. Empty "
            "without the scope read"
        ),
    ]


class Problem(Answer):
    """An error, as RFC 9457 problem details. ``code`` and ``kind`` are stable."""

    type: str = "about:blank"
    title: Annotated[str, Field(description="the HTTP status in words")]
    status: int
    detail: Annotated[str, Field(description="what is wrong, for a person")]
    code: Annotated[str, Field(description="a stable word such as camera.param_count")]
    field: Annotated[str | None, Field(description="the field that is wrong")] = None
    expected: Annotated[str | None, Field(description="what would have been right")] = None
    got: Annotated[str | None, Field(description="what came instead")] = None
    kind: Annotated[str, Field(description="the kind of error, such as InvalidInput")]
    request_id: str
