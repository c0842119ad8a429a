"""The pages at ``/``, ``/docs`` and ``/redoc``: the built files of ``web/``, kept in memory."""

from __future__ import annotations

import gzip
import hashlib
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from fastapi import FastAPI, Request, Response

from service.http.cache_headers import ASK_ALWAYS, FOR_EVER, is_current, not_modified, takes_gzip
from service.page import page_folder
from visloc.errors import Unavailable, refuse

logger = logging.getLogger(__name__)

# Path by file. Swagger UI and ReDoc have the same paths as in other FastAPI services.
PAGES = {"/": "index.html", "/docs": "docs.html", "/redoc": "redoc.html"}
# Written out because `mimetypes` depends on the machine.
_TYPES = {
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".map": "application/json",
    ".png": "image/png",
    ".svg": "image/svg+xml",
    ".woff2": "font/woff2",
}
_COMPRESSED_ALREADY = (".png", ".woff2")
# No content from other hosts, no inline scripts, no framing.
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; "
    "media-src 'self' blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
# Swagger UI and ReDoc write styles and small pictures into themselves; ReDoc searches in a worker.
_POLICY_OF_REFERENCE = (
    _POLICY.replace("style-src 'self'", "style-src 'self' 'unsafe-inline'").replace(
        "img-src 'self' blob:", "img-src 'self' data:"
    )
    + "; worker-src blob:"
)
_SAFE = {
    "Cross-Origin-Opener-Policy": "same-origin",
    "Permissions-Policy": "camera=(self)",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
_READING = ["GET", "HEAD"]


@dataclass(frozen=True, slots=True, eq=False)
class _File:
    """A file of the page.

    Attributes:
        compressed: ``plain`` as gzip; None for formats that are compressed already.
    """

    plain: bytes
    compressed: bytes | None
    content_type: str
    etag: str


def add_page_routes(app: FastAPI) -> None:
    """Serve the pages. If they were not built, log that and answer 404."""
    try:
        pages, assets = _read(page_folder())
    except Unavailable as error:
        logger.warning("no page at /: %s", error)
        pages, assets = {}, {}

    async def page(request: Request) -> Response:
        path = request.scope["path"]
        if path not in pages:
            raise refuse("page.not_built")
        policy = _POLICY if path == "/" else _POLICY_OF_REFERENCE
        return _answer(pages[path], request, ASK_ALWAYS, policy)

    for path in PAGES:
        app.add_api_route(path, page, methods=_READING, include_in_schema=False)

    @app.api_route("/assets/{name}", methods=_READING, include_in_schema=False)
    async def asset(request: Request, name: str) -> Response:
        if name not in assets:
            raise refuse("http.not_found", got=name)
        return _answer(assets[name], request, FOR_EVER)  # names contain a hash of the content


def _read(folder: Path) -> tuple[Mapping[str, _File], Mapping[str, _File]]:
    """Read the pages, and the assets by name, so that a requested name never becomes a path."""
    assets = {path.name: _read_file(path) for path in sorted((folder / "assets").glob("*"))}
    return {path: _read_file(folder / name) for path, name in PAGES.items()}, assets


def _read_file(path: Path) -> _File:
    plain = path.read_bytes()
    packed = None if path.suffix in _COMPRESSED_ALREADY else gzip.compress(plain, mtime=0)
    content_type = _TYPES.get(path.suffix, "application/octet-stream")
    return _File(plain, packed, content_type, hashlib.sha256(plain).hexdigest()[:32])


def _answer(file: _File, request: Request, cache_control: str, policy: str = _POLICY) -> Response:
    body, etag = file.plain, f'"{file.etag}"'
    headers = _SAFE | {
        "Content-Security-Policy": policy,
        "Cache-Control": cache_control,
        "Vary": "Accept-Encoding",
    }
    if file.compressed is not None and takes_gzip(request.headers):
        body, etag = file.compressed, f'"{file.etag}-gzip"'
        headers["Content-Encoding"] = "gzip"
    headers["ETag"] = etag
    if is_current(request.headers, etag):
        return not_modified(headers)
    return Response(body, headers=headers, media_type=file.content_type)
