"""What can be asked of a server, before any transport has a say in it."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx

from clients.features import Features
from clients.types import LocalizeOptions
from visloc.errors import InvalidInput
from visloc.geometry import Camera

JsonObject = dict[str, Any]
# The encoded photo, the path of the file that holds it, or what was found in it.
PhotoOrFeatures = bytes | str | Path | Features

# The first character keeps ``.`` and ``..`` out of the path of a URL; the server has the rest.
_MAP = re.compile(r"[A-Za-z0-9][A-Za-z0-9._@-]*")
_REQUEST_ID = re.compile(r"[\x21-\x7e]{1,128}")
_SERVER = re.compile(
    r"(?:(?P<scheme>https?)|grpc)://"
    r"(?:(?:[A-Za-z0-9_-]{1,63}\.)*[A-Za-z0-9_-]{1,63}\.?|\[[0-9A-Fa-f:.]+\])"
    r"(?::(?P<port>\d{1,5}))?(?(scheme)(?:/[^\s?#]*)?|/?)"
)


@dataclass(frozen=True, slots=True)
class Localize:
    """Localize one photo, or its features; see ``localize_request``."""

    query: bytes | Features
    map: str
    camera: Camera | None
    options: LocalizeOptions
    request_id: str | None


@dataclass(frozen=True, slots=True)
class ListMaps:
    """List the maps."""


@dataclass(frozen=True, slots=True)
class GetMap:
    """Describe the map ``id`` or ``id@version``."""

    map: str


@dataclass(frozen=True, slots=True)
class GetServer:
    """Tell the server's version."""


@dataclass(frozen=True, slots=True)
class CheckReady:
    """Tell whether the server can answer now."""


Request = Localize | ListMaps | GetMap | GetServer | CheckReady


def localize_request(
    query: PhotoOrFeatures,
    map_ref: str,
    camera: Camera | None,
    options: LocalizeOptions | Mapping[str, Any] | None,
    request_id: str | None,
) -> Localize:
    """Check and complete what ``localize`` was called with; a path is read here.

    Raises:
        InvalidInput: ``image.unreadable``, ``map.id``, ``options.*`` or ``request.id``.
    """
    if request_id is not None and not _REQUEST_ID.fullmatch(request_id):
        raise InvalidInput(
            "request.id",
            "not usable",
            field="request_id",
            expected="1 to 128 visible ASCII characters",
            got=request_id,
        )
    if not isinstance(options, LocalizeOptions):
        options = LocalizeOptions.from_mapping(options or {})
    if isinstance(query, str | Path):
        query = read_image(Path(query))
    return Localize(query, _checked(map_ref), camera, options, request_id)


def get_map_request(map_ref: str) -> GetMap:
    """Check the name of a map.

    Raises:
        InvalidInput: ``map.id``.
    """
    return GetMap(_checked(map_ref))


def read_image(path: Path) -> bytes:
    """Read the bytes of a photo.

    Raises:
        InvalidInput: ``image.unreadable``.
    """
    try:
        return path.read_bytes()
    except OSError as error:
        raise InvalidInput(
            "image.unreadable",
            "the photo cannot be read",
            field=str(path),
            got=error.strerror or str(error),
        ) from error


def checked_server(server: str) -> str:
    """Return the address of a server, as given.

    Raises:
        InvalidInput: ``server.url``.
    """
    match = _SERVER.fullmatch(server)
    if match is None or not 0 < int(match["port"] or 80) < 65536 or not _is_url(server):
        raise InvalidInput(
            "server.url",
            "not the address of a server",
            field="server",
            expected="http://host:port, https://host:port or grpc://host:port",
            got=server,
        )
    return server


def _is_url(text: str) -> bool:
    try:
        return bool(httpx.URL(text).host)  # knows which IP addresses and names are none
    except (httpx.InvalidURL, UnicodeError):
        return False


def _checked(map_ref: str) -> str:
    if not _MAP.fullmatch(map_ref):
        raise InvalidInput(
            "map.id",
            "not the name of a map",
            field="map",
            expected="id or id@version, of letters, digits, '.', '_' and '-'",
            got=map_ref,
        )
    return map_ref
