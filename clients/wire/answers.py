"""From the plain JSON that every transport gives to the types that callers get."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any, ParamSpec, TypeVar

from pydantic import BeforeValidator, Field, SkipValidation, ValidationError, model_validator

from clients.errors import INTERNAL, not_understood, received
from clients.wire.requests import JsonObject
from visloc.errors import InvalidInput, VislocError
from visloc_api.words.answers import ImageAnswer, InstantAnswer, LocalizeResponse
from visloc_api.words.maps import ListMapsResponse, MapInfo
from visloc_api.words.poses import CoarsePose, PoseEstimate
from visloc_api.words.status import Health

_P = ParamSpec("_P")
_T = TypeVar("_T")

# The answer as received; the same over HTTP and gRPC.
_Raw = Annotated[SkipValidation[Mapping[str, Any]], Field(exclude=True, repr=False)]


class LocalizeResult(LocalizeResponse):
    """The answer to one photo."""

    raw: _Raw

    @model_validator(mode="before")
    @classmethod
    def _say_status(cls, values: Any) -> Any:
        if "status" not in values:
            status = "not_localized" if values.get("pose") is None else "localized"
            values = {**values, "status": status}
        return values


def _error(value: Any) -> Any:
    if isinstance(value, Mapping):
        return received(value, INTERNAL, "the photo could not be used")
    return value


class ImageResult(ImageAnswer):
    """The result for one photo of an instant.

    Attributes:
        error: why the photo could not be used; then at most ``cam_from_world`` is known.
    """

    error: Annotated[VislocError | None, BeforeValidator(_error)]  # type: ignore[assignment]


class InstantResult(InstantAnswer):
    """The answer to the photos of one instant."""

    images: tuple[ImageResult, ...]
    raw: _Raw


class ServerInfo(Health):
    """The server itself.

    Attributes:
        version: of the service; None when a gRPC server does not say.
    """

    version: str | None  # type: ignore[assignment]


def parse_answer(server: str, parse: Callable[_P, _T], *given: _P.args, **named: _P.kwargs) -> _T:
    """Parse an answer, and blame the server for one that cannot be."""
    try:
        return parse(*given, **named)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(map(str, first["loc"]))
        raise not_understood(server, f"{place}: {first['msg']}") from None
    except (KeyError, TypeError, ValueError, OverflowError, InvalidInput) as error:
        raise not_understood(server, f"{type(error).__name__}: {error}") from error


def parse_result(raw: JsonObject) -> LocalizeResult:
    """Parse a LocalizeResponse."""
    return LocalizeResult.model_validate({**raw, "status": raw["status"], "raw": raw})


def parse_pose(raw: JsonObject) -> PoseEstimate:
    """Parse a PoseEstimate."""
    return PoseEstimate.model_validate(raw)


def parse_coarse(raw: JsonObject) -> CoarsePose:
    """Parse a CoarsePose."""
    return CoarsePose.model_validate(raw)


def parse_instant(raw: JsonObject) -> InstantResult:
    """Parse an InstantAnswer."""
    return InstantResult.model_validate({**raw, "raw": raw})


def parse_maps(raw: JsonObject) -> list[MapInfo]:
    """Parse a ListMapsResponse."""
    return list(ListMapsResponse.model_validate(raw).maps)


def parse_map(raw: JsonObject) -> MapInfo:
    """Parse a MapInfo."""
    return MapInfo.model_validate(raw)


def parse_server(raw: JsonObject) -> ServerInfo:
    """Parse what a server says of itself."""
    return ServerInfo(version=raw["version"])


def parse_ready(raw: JsonObject) -> bool:
    """Parse whether a server can answer now."""
    return bool(raw["ready"])
