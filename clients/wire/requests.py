"""What can be asked of a server, before any transport has a say in it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx

from clients.wire.features import Features, PhotoOrFeatures
from clients.wire.priors import priors_from_json
from clients.wire.types import LocalizeOptions
from visloc.errors import refuse
from visloc.geometry import Camera
from visloc.priors import NO_PRIORS, Priors
from visloc.types import Near
from visloc_api.words.wire import REQUEST_ID

JsonObject = dict[str, Any]
# A map, several, or the anchored ones around a place.
Where = str | Sequence[str] | Near

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
    """Where to search, and how; see ``checked_search``."""

    maps: tuple[str, ...] | Near
    options: LocalizeOptions
    priors: Priors
    request_id: str | None
    ypr: bool = False


@dataclass(frozen=True, slots=True)
class Localize:
    """Localize one photo, or its features; see ``localize_request``."""

    search: Search
    query: bytes | Features
    camera: Camera | None
    debug: bool = False


@dataclass(frozen=True, slots=True)
class ListMaps:
    """List the maps: all, or the anchored ones that reach into a circle."""

    near: Near | None = None


@dataclass(frozen=True, slots=True)
class GetMap:
    """Describe the map ``id`` or ``id@version``."""

    map: str


@dataclass(frozen=True, slots=True)
class GetVersion:
    """Describe a version of a map, in use or not; see ``checked_version``."""

    map_id: str
    version: str


@dataclass(frozen=True, slots=True)
class UseVersion:
    """Put a version of a map into use."""

    map_id: str
    version: str


@dataclass(frozen=True, slots=True)
class DeleteVersion:
    """Delete a version of a map that is not in use."""

    map_id: str
    version: str


@dataclass(frozen=True, slots=True)
class GetServer:
    """Tell the server's version."""


@dataclass(frozen=True, slots=True)
class CheckReady:
    """Tell whether the server can answer now."""


Request = (
    Localize | ListMaps | GetMap | GetVersion | UseVersion | DeleteVersion | GetServer | CheckReady
)


def localize_request(
    search: Search, query: PhotoOrFeatures, camera: Camera | None, *, debug: bool = False
) -> Localize:
    """Complete what ``localize`` was called with; a path is read here.

    Raises:
        InvalidInput: ``image.unreadable``.
    """
    return Localize(search, read_query(query), camera, debug)


def checked_search(
    where: Where,
    options: LocalizeOptions | Mapping[str, Any] | None,
    priors: Priors | Mapping[str, Any] | None,
    request_id: str | None,
    *,
    ypr: bool = False,
) -> Search:
    """Check what all that localizes has in common.

    Raises:
        InvalidInput: ``map.id``, ``request.map`` for no map, ``options.*``, ``priors.*`` or
            ``request.id``.
    """
    if request_id is not None and not REQUEST_ID.fullmatch(request_id):
        raise refuse("request.id", field="request_id", got=request_id)
    if not isinstance(options, LocalizeOptions):
        options = LocalizeOptions.from_mapping(options or {})
    if not isinstance(priors, Priors):
        priors = NO_PRIORS if priors is None else priors_from_json(priors)
    if isinstance(where, Near):
        return Search(where, options, priors, request_id, ypr)
    maps = (where,) if isinstance(where, str) else tuple(where)
    if not maps:
        raise refuse(
            "request.map", "there is no map to search", field="map", expected="a map, or several"
        )
    return Search(tuple(map(_checked, maps)), options, priors, request_id, ypr)


def get_map_request(map_ref: str) -> GetMap:
    """Check the name of a map.

    Raises:
        InvalidInput: ``map.id``.
    """
    return GetMap(_checked(map_ref))


def checked_version(map_id: str, version: str) -> tuple[str, str]:
    """Check the names of a map and its version, and return them.

    Raises:
        InvalidInput: ``map.id``.
    """
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


def read_query(query: PhotoOrFeatures) -> bytes | Features:
    """Return what is sent of a photo.

    Raises:
        InvalidInput: ``image.unreadable``.
    """
    return read_image(Path(query)) if isinstance(query, str | Path) else query


def read_image(path: Path) -> bytes:
    """Read the bytes of a photo.

    Raises:
        InvalidInput: ``image.unreadable``.
    """
    try:
        return path.read_bytes()
    except OSError as error:
        raise refuse(
            "image.unreadable", field=str(path), got=error.strerror or str(error)
        ) from error


def checked_server(server: str) -> str:
    """Return the address of a server, as given.

    Raises:
        InvalidInput: ``server.url``.
    """
    match = _SERVER.fullmatch(server)
    if match is None or not 0 < int(match["port"] or 80) < 65536 or not _is_url(server):
        raise refuse("server.url", field="server", got=server)
    return server


def _is_url(text: str) -> bool:
    try:
        return bool(httpx.URL(text).host)  # knows which IP addresses and names are none
    except (httpx.InvalidURL, UnicodeError):
        return False


def _checked(map_ref: str) -> str:
    if not _MAP.fullmatch(map_ref):
        raise refuse(
            "map.id",
            field="map",
            expected="id or id@version, of letters, digits, '.', '_' and '-'",
            got=map_ref,
        )
    return map_ref
