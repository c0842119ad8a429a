"""Requests as HTTP: method, path, and the parameters of httpx."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, assert_never

import httpx

from clients.transport.retry import map_header
from clients.transport.uploads import Upload
from clients.wire.requests import (
    CheckReady,
    DeleteVersion,
    GetImages,
    GetMap,
    GetServer,
    GetVersion,
    JsonObject,
    ListMaps,
    Localize,
    Request,
    StartSequence,
    UseVersion,
)
from visloc.types import Near
from visloc_api.words import rigs, sequences
from visloc_api.words.photo import LocalizeRequest
from visloc_api.words.wire import NDJSON, REQUEST_ID_HEADER, TIMEOUT_HEADER


def encode_request(request: Request, timeout_s: float) -> tuple[str, str, dict[str, Any]]:
    """Return method, path, and the parameters of httpx."""
    method, path, parts = _encode(request, timeout_s)
    return method, path, {**parts, "headers": map_header(request) | parts.get("headers", {})}


def _encode(request: Request, timeout_s: float) -> tuple[str, str, dict[str, Any]]:
    match request:
        case Localize(words=words):
            headers = _headers(request, timeout_s)
            if isinstance(words, LocalizeRequest):
                return "POST", "/localize", {**_photo_form(words), "headers": headers}
            files = _Files()
            body = words.model_copy(update={"images": files.parts(words.images)}).as_json()
            return "POST", "/localize/rig", files.form(body, headers)
        case ListMaps():
            return "GET", "/maps", {} if request.near is None else {"params": _near(request.near)}
        case GetMap():
            return "GET", f"/maps/{request.map}", {}
        case GetImages():
            params = {"first": request.first, "count": request.count}
            return "GET", f"/maps/{request.map}/images", {"params": params}
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
    start: StartSequence, instants: Sequence[sequences.Instant], timeout_s: float
) -> tuple[str, str, dict[str, Any]]:
    """Encode a sequence as ``encode_request`` does other requests."""
    files = _Files()
    body = start.words.as_json() | {
        "instants": [
            each.model_copy(update={"images": files.parts(each.images)}).as_json()
            for each in instants
        ]
    }
    headers = _headers(start, timeout_s) | map_header(start) | {"Accept": NDJSON}
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

    def parts(self, images: Iterable[rigs.RigImage]) -> list[rigs.RigImage]:
        """Add photos, and return the images that name them instead."""
        return [
            image if image.image is None else self._as_parts(image, image.image) for image in images
        ]

    def form(self, body: JsonObject, headers: Mapping[str, str]) -> dict[str, Any]:
        # A part of its own type, also without photos, so that the body is a form in any case.
        text = json.dumps(body).encode()
        files = {"request": (None, text, "application/json"), **self._parts}
        return {"files": files, "headers": headers}

    def _as_parts(self, image: rigs.RigImage, photo: bytes) -> rigs.RigImage:
        named: dict[str, str | None] = {"image": None, "part": self._add(photo)}
        if image.mask is not None:
            named |= {"mask": None, "mask_part": self._add(image.mask)}
        return image.model_copy(update=named)

    def _add(self, photo: bytes) -> str:
        name = f"image{len(self._parts)}"
        self._parts[name] = ("photo", photo, "application/octet-stream")
        return name


def _photo_form(words: LocalizeRequest) -> dict[str, Any]:
    """Return the form for one photo: a file, and texts."""
    rest = words.model_copy(update={"image": None, "features": None, "mask": None}).as_json()
    texts = {name: value if name == "map" else json.dumps(value) for name, value in rest.items()}
    if words.features is None:
        file = ("photo", words.image, "application/octet-stream")
        files = {"image": file}
        if words.mask is not None:
            files["mask"] = ("mask", words.mask, "application/octet-stream")
        return {"data": texts, "files": files}
    text = json.dumps(words.features.as_json()).encode()
    return {"data": texts, "files": {"features": ("features.json", text, "application/json")}}


def _near(near: Near) -> dict[str, str]:
    # repr is the shortest text that reads back as the same number.
    return {"near": f"{float(near.latitude)!r},{float(near.longitude)!r},{float(near.radius)!r}"}


def _headers(request: Localize | StartSequence, timeout_s: float) -> dict[str, str]:
    # So that the server does not work for a caller that no longer waits.
    headers = {TIMEOUT_HEADER: f"{timeout_s:g}"}
    if request.request_id is not None:
        headers[REQUEST_ID_HEADER] = request.request_id
    return headers
