"""Requests as HTTP: method, path, and the parameters of httpx."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, assert_never

import httpx

from clients.transport.retry import map_header
from clients.transport.uploads import Upload
from clients.wire.features import Features
from clients.wire.priors import priors_as_json
from clients.wire.requests import (
    CheckReady,
    DeleteVersion,
    GetMap,
    GetServer,
    GetVersion,
    JsonObject,
    ListMaps,
    Localize,
    Search,
    UseVersion,
)
from clients.wire.rig_requests import (
    AnyRequest,
    LocalizeRig,
    SentImage,
    SentInstant,
    SequenceStart,
    camera_as_json,
    odometry_as_json,
    rig_as_json,
    search_as_json,
)
from visloc.types import Near
from visloc_api.words.wire import NDJSON, REQUEST_ID_HEADER, TIMEOUT_HEADER


def encode_request(request: AnyRequest, timeout_s: float) -> tuple[str, str, dict[str, Any]]:
    """Return method, path, and the parameters of httpx."""
    method, path, parts = _encode(request, timeout_s)
    return method, path, {**parts, "headers": map_header(request) | parts.get("headers", {})}


def _encode(request: AnyRequest, timeout_s: float) -> tuple[str, str, dict[str, Any]]:
    match request:
        case Localize():
            headers = _headers(request.search, timeout_s)
            fields = _fields(request)
            parts = {"data": fields, "files": _file(request.query), "headers": headers}
            return "POST", "/localize", parts
        case LocalizeRig():
            files = _Files()
            body = search_as_json(request.search) | {
                "rig": rig_as_json(request.rig),
                "images": files.images(request.images),
            }
            return "POST", "/localize/rig", files.form(body, _headers(request.search, timeout_s))
        case ListMaps():
            return "GET", "/maps", {} if request.near is None else {"params": _near(request.near)}
        case GetMap():
            return "GET", f"/maps/{request.map}", {}
        case GetVersion():
            return "GET", _version_path(request.map_id, request.version), {}
        case UseVersion():
            return "POST", f"/maps/{request.map_id}/current", {"json": {"version": request.version}}
        case DeleteVersion():
            return "DELETE", _version_path(request.map_id, request.version), {}
        case GetServer():
            return "GET", "/healthz", {}
        case CheckReady():
            return "GET", "/readyz", {}
    assert_never(request)


def _version_path(map_id: str, version: str) -> str:
    return f"/maps/{map_id}/versions/{version}"


def encode_sequence(
    start: SequenceStart, instants: Sequence[SentInstant], timeout_s: float
) -> tuple[str, str, dict[str, Any]]:
    """Encode a sequence as ``encode_request`` does other requests."""
    files = _Files()
    body = search_as_json(start.search) | {"instants": [files.instant(i) for i in instants]}
    if start.rig is not None:
        body["rig"] = rig_as_json(start.rig)
    if start.time_unit is not None:
        body["time_unit"] = start.time_unit
    if start.max_gap_s is not None:
        body["max_gap_s"] = start.max_gap_s
    headers = _headers(start.search, timeout_s) | map_header(start) | {"Accept": NDJSON}
    return "POST", "/localize/sequence", files.form(body, headers)


def encode_upload(upload: Upload, timeout_s: float) -> tuple[str, str, dict[str, Any]]:
    """Encode all of an upload except the bytes of the file."""
    headers = {"Content-Type": "application/zip", "Content-Length": str(upload.size_bytes)}
    headers |= map_header(upload)
    timeout = httpx.Timeout(timeout_s, read=upload.verified_within_s(timeout_s))
    path = _version_path(upload.map_id, upload.version)
    return "PUT", path, {"headers": headers, "timeout": timeout}


class _Files:
    """The photos of a form; its part ``request`` names and describes them."""

    def __init__(self) -> None:
        self._parts: dict[str, tuple[str, bytes, str]] = {}

    def images(self, images: Iterable[SentImage]) -> list[JsonObject]:
        """Add photos, and return their descriptions."""
        return [self._image(image) for image in images]

    def instant(self, instant: SentInstant) -> JsonObject:
        """Add the photos of an instant, and return its description."""
        entry: JsonObject = {
            "timestamp": instant.timestamp,
            "images": self.images(instant.images),
        }
        if instant.odometry is not None:
            entry["odometry"] = odometry_as_json(instant.odometry)
        if instant.priors is not None:
            entry["priors"] = priors_as_json(instant.priors)
        return entry

    def form(self, body: JsonObject, headers: Mapping[str, str]) -> dict[str, Any]:
        # A part of its own type, also without photos, so that the body is a form in any case.
        text = json.dumps(body).encode()
        files = {"request": (None, text, "application/json"), **self._parts}
        return {"files": files, "headers": headers}

    def _image(self, image: SentImage) -> JsonObject:
        entry: JsonObject = {"sensor": image.sensor}
        if isinstance(image.query, Features):
            entry["features"] = image.query.as_json()
        else:
            name = f"image{len(self._parts)}"
            self._parts[name] = ("photo", image.query, "application/octet-stream")
            entry["part"] = name
        if image.camera is not None:
            entry["camera"] = camera_as_json(image.camera)
        if image.timestamp is not None:
            entry["timestamp"] = image.timestamp
        return entry


def _fields(request: Localize) -> dict[str, str]:
    """Return the text fields of the form for one photo."""
    entry = search_as_json(request.search)
    fields = {name: json.dumps(value) for name, value in entry.items() if name != "map"}
    if "map" in entry:
        fields["map"] = entry["map"]
    if request.camera is not None:
        fields["camera"] = json.dumps(camera_as_json(request.camera))
    if request.debug:
        fields["debug"] = "true"
    return fields


def _near(near: Near) -> dict[str, str]:
    # repr is the shortest text that reads back as the same number.
    return {"near": f"{float(near.latitude)!r},{float(near.longitude)!r},{float(near.radius)!r}"}


def _headers(search: Search, timeout_s: float) -> dict[str, str]:
    # So that the server does not work for a caller that no longer waits.
    headers = {TIMEOUT_HEADER: f"{timeout_s:g}"}
    if search.request_id is not None:
        headers[REQUEST_ID_HEADER] = search.request_id
    return headers


def _file(query: bytes | Features) -> dict[str, tuple[str, bytes, str]]:
    if isinstance(query, Features):
        text = json.dumps(query.as_json()).encode()
        return {"features": ("features.json", text, "application/json")}
    return {"image": ("photo", query, "application/octet-stream")}
