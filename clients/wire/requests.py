"""Requests to a server, independent of the transport."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx

import visloc_api.words.features
import visloc_api.words.near
import visloc_api.words.priors
from clients.wire.features import Features, PhotoOrFeatures
from clients.wire.options import checked_options
from clients.wire.rigs import Instant, Rig, RigImage
from visloc.errors import VislocError, inside, refuse
from visloc.geometry import Camera
from visloc.priors import Priors
from visloc.sequences.filling import TimeUnit, guess_time_unit
from visloc.types import MaskedImage, Near, RigSensor
from visloc_api.words import poses, rigs, sequences
from visloc_api.words.options import LocalizeOptions
from visloc_api.words.photo import LocalizeRequest
from visloc_api.words.wire import REQUEST_ID

JsonObject = dict[str, Any]
# A map, several, or the anchored ones around a place.
Where = str | Sequence[str] | Near

_A_RIG = "the id of a rig that the map knows, or its cameras as RigSensor by name"

# The first character keeps ``.`` and ``..`` out of the path of a URL; the server has the rest.
_MAP = re.compile(r"[A-Za-z0-9][A-Za-z0-9._@-]*")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_SERVER = re.compile(
    r"(?:(?P<scheme>https?)|grpcs?)://"
    r"(?:(?:[A-Za-z0-9_-]{1,63}\.)*[A-Za-z0-9_-]{1,63}\.?|\[[0-9A-Fa-f:.]+\])"
    r"(?::(?P<port>\d{1,5}))?(?(scheme)(?:/[^\s?#]*)?|/?)"
)


@dataclass(frozen=True, slots=True)
class Search:
    """Where to search, and how.

    Attributes:
        words: the fields that all requests that localize share.
        request_id: names the request in the server's logs.
    """

    words: Mapping[str, Any]
    request_id: str | None


@dataclass(frozen=True, slots=True)
class Localize:
    """Localize one photo, or the photos of a rig."""

    words: LocalizeRequest | rigs.LocalizeRigRequest
    request_id: str | None


@dataclass(frozen=True, slots=True)
class StartSequence:
    """Localize the instants that follow; the words are what they share."""

    words: sequences.SequenceStart
    request_id: str | None


@dataclass(frozen=True, slots=True)
class ListMaps:
    """List the maps: all, or the anchored ones that reach into a circle."""

    near: Near | None = None


@dataclass(frozen=True, slots=True)
class GetMap:
    """Describe the map ``id`` or ``id@version``."""

    map: str


@dataclass(frozen=True, slots=True)
class GetImages:
    """Tell where photos of a map were taken, and by which cameras; see ``get_map_request``."""

    map: str
    first: int
    count: int


@dataclass(frozen=True, slots=True)
class GetVersion:
    """Describe a version of a map, current or not; see ``checked_version``."""

    map_id: str
    version: str


@dataclass(frozen=True, slots=True)
class UseVersion:
    """Put a version of a map into use."""

    map_id: str
    version: str


@dataclass(frozen=True, slots=True)
class DeleteVersion:
    """Delete a version of a map that is not the current one."""

    map_id: str
    version: str


@dataclass(frozen=True, slots=True)
class GetServer:
    """Tell the server's version."""


@dataclass(frozen=True, slots=True)
class CheckReady:
    """Tell whether the server can answer now."""


_OfMap = GetMap | GetImages | GetVersion | UseVersion | DeleteVersion
Request = Localize | ListMaps | _OfMap | GetServer | CheckReady


def checked_search(
    where: Where,
    options: LocalizeOptions | Mapping[str, Any] | None,
    priors: Priors | Mapping[str, Any] | None,
    request_id: str | None,
    *,
    ypr: bool = False,
) -> Search:
    """Check what all that localizes has in common."""
    if request_id is not None and not REQUEST_ID.fullmatch(request_id):
        raise refuse("request.id", field="request_id", got=request_id)
    words = _where(where)
    chosen = checked_options(options or {})
    if chosen.given():
        words["options"] = chosen
    if priors is not None:
        if not isinstance(priors, Priors):
            priors = visloc_api.words.priors.Priors.read(priors).to_core()
        said = visloc_api.words.priors.Priors.from_core(priors)
        if said.given():
            words["priors"] = said
    if ypr:
        words["ypr"] = True
    return Search(words, request_id)


def _where(where: Where) -> dict[str, Any]:
    if isinstance(where, Near):
        return {"near": visloc_api.words.near.Near.from_core(where)}
    maps = [where] if isinstance(where, str) else list(where)
    if not maps:
        raise refuse(
            "request.map", "there is no map to search", field="map", expected="a map, or several"
        )
    for each in maps:
        _check_map(each)
    return {"map": maps[0]} if len(maps) == 1 else {"maps": maps}


def photo_request(
    search: Search, query: PhotoOrFeatures, camera: Camera | None, *, debug: bool = False
) -> Localize:
    """Complete what ``localize`` was called with; a path is read here."""
    photo = _photo(query, camera)
    words = LocalizeRequest(**search.words, **photo, debug=debug or None)
    return Localize(words, search.request_id)


def rig_request(search: Search, rig: Rig, images: Iterable[RigImage]) -> Localize:
    """Check and complete what ``localize_rig`` was called with; paths are read here."""
    if rig is None:  # from callers without a type checker
        raise refuse("request.missing_field", field="rig", expected=_A_RIG)
    words = rigs.LocalizeRigRequest(**search.words, rig=_rig(rig), images=_images(images, "images"))
    return Localize(words, search.request_id)


def sequence_start(
    search: Search, rig: Rig | None, time_unit: str | None, max_gap_s: float | None
) -> StartSequence:
    """Check what ``localize_sequence`` was called with."""
    if max_gap_s is not None and not (math.isfinite(max_gap_s) and max_gap_s >= 0):
        raise refuse(
            "sequence.max_gap", field="max_gap_s", expected="seconds, 0 or more", got=max_gap_s
        )
    words = sequences.SequenceStart(
        **search.words,
        rig=None if rig is None else _rig(rig),
        time_unit=time_unit,
        max_gap_s=max_gap_s,
    )
    return StartSequence(words, search.request_id)


def instant_words(instant: Instant, index: int) -> sequences.Instant:
    """Check an instant of a sequence and read its photos."""
    odometry, priors = instant.odometry, instant.priors
    images = _images(instant.images, f"instants[{index}].images")
    with inside(f"instants[{index}]"):
        return sequences.Instant(
            timestamp=instant.timestamp,
            images=images,
            odometry=None if odometry is None else sequences.Odometry.from_core(odometry),
            priors=None if priors is None else visloc_api.words.priors.Priors.from_core(priors),
        )


def check_time_unit(time_unit: str | None, first_timestamp: int) -> None:
    """Refuse a sequence whose unit of time is neither said nor told by its first timestamp."""
    if time_unit is None and guess_time_unit([first_timestamp]) is None:
        raise refuse(
            "sequence.time_unit",
            "the size of the timestamps does not reveal their unit",
            field="time_unit",
            expected=TimeUnit,
        )


def _rig(rig: Rig) -> str | rigs.RigCalibration:
    if isinstance(rig, str):
        return rig
    if not isinstance(rig, Mapping):
        raise _unusable("rig", _A_RIG, rig)
    for name, sensor in rig.items():
        if not isinstance(sensor, RigSensor):
            raise _unusable(f"rig.sensors.{name}", "a RigSensor", sensor)
    return rigs.RigCalibration.from_core(rig)


def _images(images: Iterable[RigImage], field: str) -> list[rigs.RigImage]:
    if isinstance(images, Mapping) or not isinstance(images, Iterable):
        raise _unusable(field, "a list of RigImage", images)
    return [_image(image, f"{field}[{number}]") for number, image in enumerate(images)]


def _image(image: RigImage, field: str) -> rigs.RigImage:
    if not isinstance(image, RigImage):
        raise _unusable(field, "a RigImage", image)
    photo = _photo(image.query, image.camera)
    with inside(field):
        return rigs.RigImage(sensor=image.sensor, **photo, timestamp=image.timestamp)


def _photo(query: PhotoOrFeatures, camera: Camera | None) -> dict[str, Any]:
    """Return the fields that say a photo or its features, and its camera."""
    content = read_query(query)
    said = {"camera": None if camera is None else poses.Camera.from_core(camera)}
    if isinstance(content, Features):
        return said | {"features": visloc_api.words.features.Features.from_core(content)}
    if isinstance(content, MaskedImage):
        return said | {"image": content.image, "mask": content.mask}
    return said | {"image": content}


def _unusable(field: str, expected: str, got: object) -> VislocError:
    return refuse("request.invalid", field=field, expected=expected, got=type(got).__name__)


def get_map_request(map_ref: str) -> GetMap:
    """Check the name of a map."""
    _check_map(map_ref)
    return GetMap(map_ref)


def checked_version(map_id: str, version: str) -> tuple[str, str]:
    """Check the names of a map and its version, and return them."""
    for name, what in ((map_id, "map"), (version, "map version")):
        if not _NAME.fullmatch(name):
            raise refuse(
                "map.id",
                f"this is not a valid name of a {what}",
                field="map",
                expected="letters, digits, '.', '_' and '-', beginning with a letter or digit",
                got=name,
            )
    return map_id, version


def read_query(query: PhotoOrFeatures) -> bytes | MaskedImage | Features:
    """Return what is sent of a photo."""
    return read_image(Path(query)) if isinstance(query, str | Path) else query


def read_image(path: Path) -> bytes:
    """Read the bytes of a photo."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise refuse(
            "image.unreadable", field=str(path), got=error.strerror or str(error)
        ) from error


def checked_server(server: str) -> str:
    """Return the address of a server, as given."""
    match = _SERVER.fullmatch(server)
    if match is None or not 0 < int(match["port"] or 80) < 65536 or not _is_url(server):
        raise refuse("server.url", field="server", got=server)
    return server


def _is_url(text: str) -> bool:
    try:
        return bool(httpx.URL(text).host)  # knows which IP addresses and names are none
    except (httpx.InvalidURL, UnicodeError):
        return False


def _check_map(map_ref: str) -> None:
    if not _MAP.fullmatch(map_ref):
        raise refuse(
            "map.id",
            field="map",
            expected="id or id@version, of letters, digits, '.', '_' and '-'",
            got=map_ref,
        )
