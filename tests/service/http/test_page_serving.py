"""The files of the page at /."""

from __future__ import annotations

import asyncio
import gzip
import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi import FastAPI
from starlette.datastructures import Headers

import service.http.static_page
from service.http.app import create_app
from service.http.arrivals import Arrivals
from service.http.cache_headers import is_current, takes_gzip
from service.http.envelope import Backend
from service.security.access import needed_over_http, open_access
from service.security.key_file import Scope, edited_keys, new_key
from service.settings import ServiceSettings
from service.telemetry.metrics import Metrics, ServiceState
from service.telemetry.observer import Observer
from visloc.errors import Unavailable

INDEX = b'<!doctype html><script type="module" src="./assets/index-1a2b.js"></script>' + b" " * 500
SCRIPT = b"export const answer = 42;\n" * 100
LOGO = b"\x89PNG" + bytes(range(200))


@dataclass
class Idle:
    """An engine of a server that nobody asks for poses."""

    draining = False


@pytest.fixture(autouse=True)
def built(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "page"
    (folder / "assets").mkdir(parents=True)
    (folder / "index.html").write_bytes(INDEX)
    (folder / "docs.html").write_bytes(b"<!doctype html>Swagger UI")
    (folder / "redoc.html").write_bytes(b"<!doctype html>ReDoc")
    (folder / "assets" / "index-1a2b.js").write_bytes(SCRIPT)
    (folder / "assets" / "index-3c4d.css").write_bytes(b"body { color: black }")
    (folder / "assets" / "logo.png").write_bytes(LOGO)
    (folder / "assets" / "odd.xyz").write_bytes(b"<script>")
    (tmp_path / "secret.txt").write_text("secret")
    monkeypatch.setattr(service.http.static_page, "page_folder", lambda: folder)
    return folder


def app_with(**settings: Any) -> FastAPI:
    read = ServiceSettings(**settings)
    engine: Any = Idle()
    return create_app(
        Backend(
            engine,
            read,
            Observer(Metrics()),
            open_access(read),
            Arrivals(1.0, 1),
            lambda: ServiceState(ready=True),
        )
    )


Ask = Callable[..., httpx.Response]


def ask(app: FastAPI, path: str, method: str = "GET", **headers: str) -> httpx.Response:
    async def asked() -> httpx.Response:
        transport = httpx.ASGITransport(app)
        async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as http:
            named = {"accept-encoding": "identity"} | {
                name.replace("_", "-"): value for name, value in headers.items()
            }
            return await http.request(method, path, headers=named)

    return asyncio.run(asked())


def code_of(response: httpx.Response) -> tuple[int, str]:
    assert response.headers["content-type"] == "application/problem+json"
    return response.status_code, response.json()["code"]


@pytest.mark.parametrize(
    ("path", "content", "content_type"),
    [
        ("/", INDEX, "text/html; charset=utf-8"),
        ("/assets/index-1a2b.js", SCRIPT, "text/javascript; charset=utf-8"),
        ("/assets/index-3c4d.css", b"body { color: black }", "text/css; charset=utf-8"),
        ("/assets/logo.png", LOGO, "image/png"),
        ("/assets/odd.xyz", b"<script>", "application/octet-stream"),
    ],
)
def test_the_files_are_served_with_what_they_are_and_may_do(
    path: str, content: bytes, content_type: str
) -> None:
    answer = ask(app_with(), path)

    assert (answer.status_code, answer.content) == (200, content)
    assert answer.headers["content-type"] == content_type
    rules = answer.headers["content-security-policy"].split("; ")
    assert rules[0] == "default-src 'none'"
    assert {"script-src 'self'", "frame-ancestors 'none'"} <= set(rules)
    assert not any("unsafe" in rule or "http" in rule or "data:" in rule for rule in rules)
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["referrer-policy"] == "no-referrer"
    assert answer.headers["permissions-policy"] == "camera=(self)"
    assert answer.headers["cross-origin-opener-policy"] == "same-origin"


def test_no_page_needs_a_key() -> None:
    for path in service.http.static_page.PAGES:
        assert needed_over_http("GET", path, page=True) is None
        assert needed_over_http("POST", path, page=True) is not None
        assert needed_over_http("GET", path) is not None


@pytest.mark.parametrize("path", ["/docs", "/redoc"])
def test_the_references_may_style_themselves_but_run_no_foreign_script(path: str) -> None:
    answer = ask(app_with(), path)

    assert answer.status_code == 200
    assert answer.headers["content-type"] == "text/html; charset=utf-8"
    rules = answer.headers["content-security-policy"].split("; ")
    assert {"default-src 'none'", "script-src 'self'", "connect-src 'self'"} <= set(rules)
    assert [rule for rule in rules if "unsafe" in rule] == ["style-src 'self' 'unsafe-inline'"]
    assert not any("http" in rule for rule in rules)


@pytest.mark.parametrize("path", ["/", "/assets/index-1a2b.js"])
def test_text_is_compressed_for_who_can_read_it(path: str) -> None:
    app = app_with()
    plain = ask(app, path)
    packed = ask(app, path, accept_encoding="br, gzip;q=0.5")
    refused = ask(app, path, accept_encoding="gzip;q=0")

    assert packed.headers["content-encoding"] == "gzip"
    assert int(packed.headers["content-length"]) < len(plain.content) / 2
    assert packed.content == plain.content  # httpx unpacks it
    assert "content-encoding" not in plain.headers
    assert "content-encoding" not in refused.headers
    assert plain.headers["vary"] == packed.headers["vary"] == "Accept-Encoding"
    assert plain.headers["etag"] != packed.headers["etag"]


def test_a_picture_is_not_compressed_again() -> None:
    answer = ask(app_with(), "/assets/logo.png", accept_encoding="gzip")

    assert "content-encoding" not in answer.headers


def test_names_tell_the_content_of_assets_and_the_index_is_asked_for_again(built: Path) -> None:
    app = app_with()
    index, script = ask(app, "/"), ask(app, "/assets/index-1a2b.js")

    assert index.headers["cache-control"] == "no-cache"
    assert script.headers["cache-control"] == "public, max-age=31536000, immutable"
    again = ask(app, "/", if_none_match=index.headers["etag"])
    assert (again.status_code, again.content) == (304, b"")
    assert again.headers["etag"] == index.headers["etag"]
    (built / "index.html").write_bytes(INDEX + b"newer")
    newer = ask(app_with(), "/", if_none_match=index.headers["etag"])
    assert newer.status_code == 200


def test_head_says_the_same_without_the_file() -> None:
    app = app_with()
    for path in ("/", "/assets/index-1a2b.js"):
        got, head = ask(app, path), ask(app, path, "HEAD")
        assert head.status_code == 200
        for name in ("content-length", "content-type", "etag", "content-security-policy"):
            assert head.headers[name] == got.headers[name]


@pytest.mark.parametrize(
    "path",
    [
        "/assets/none.js",
        "/assets/",
        "/assets/%2e%2e",
        "/assets/%2e%2e%2fsecret.txt",
        "/assets/..%2findex.html",
        "/assets/..%5csecret.txt",
        "/assets/%2fetc%2fpasswd",
        "/assets//etc/passwd",
        "/assets/index-1a2b.js/",
        "/assets/index-1a2b.js%00.png",
        "/secret.txt",
        "/index.html",
    ],
)
def test_nothing_but_the_files_is_served(path: str) -> None:
    assert code_of(ask(app_with(), path)) == (404, "http.not_found")


def test_files_that_come_later_or_change_are_not_looked_at(built: Path) -> None:
    app = app_with()
    (built / "assets" / "new.js").write_text("new")
    (built / "assets" / "index-1a2b.js").write_text("changed")

    assert code_of(ask(app, "/assets/new.js")) == (404, "http.not_found")
    assert ask(app, "/assets/index-1a2b.js").content == SCRIPT


def test_other_methods_are_refused() -> None:
    app = app_with()
    for path in ("/", "/assets/index-1a2b.js"):
        assert code_of(ask(app, path, "POST")) == (405, "http.method_not_allowed")


def test_without_the_built_files_the_server_says_so_and_does_all_else(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def not_built() -> Path:
        raise Unavailable("page.not_built", "the files of the page are missing", field="/a/folder")

    monkeypatch.setattr(service.http.static_page, "page_folder", not_built)
    with caplog.at_level(logging.WARNING, "service.http.static_page"):
        app = app_with()
    (record,) = caplog.records
    assert "no page at /" in record.getMessage()
    assert "/a/folder" in record.getMessage()

    answer = ask(app, "/")
    assert code_of(answer) == (404, "page.not_built")
    assert "/a/folder" not in answer.text
    assert code_of(ask(app, "/assets/index.js")) == (404, "http.not_found")
    assert ask(app, "/healthz").status_code == 200


def test_a_page_that_is_switched_off_is_not_there_nor_looked_for(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(service.http.static_page, "page_folder", lambda: pytest.fail("looked for"))

    app = app_with(page=False)

    assert code_of(ask(app, "/")) == (404, "http.not_found")
    assert code_of(ask(app, "/assets/index.js")) == (404, "http.not_found")
    assert not caplog.records


def test_the_files_need_no_key_and_all_else_does(tmp_path: Path) -> None:
    with edited_keys(tmp_path / "keys.json") as keys:
        key, _ = new_key("reader", frozenset({Scope.READ}))
        keys.append(key)
    app = app_with(keys_file=tmp_path / "keys.json")
    closed = app_with(keys_file=tmp_path / "keys.json", page=False)

    assert ask(app, "/").status_code == 200
    assert ask(app, "/assets/index-1a2b.js").status_code == 200
    # A key of nobody's, which the user mistyped, keeps nobody from the page.
    assert ask(app, "/", authorization="Bearer nonsense").status_code == 200
    assert code_of(ask(app, "/assets/none.js")) == (404, "http.not_found")
    for path in ("/maps", "/metrics", "/nowhere", "/assets/a/b"):
        assert code_of(ask(app, path)) == (401, "access.key_missing")
    assert code_of(ask(closed, "/")) == (401, "access.key_missing")


def test_without_keys_other_names_and_origins_do_not_get_the_page() -> None:
    app = app_with()

    assert code_of(ask(app, "/", host="evil.example")) == (403, "access.host")
    assert code_of(ask(app, "/", origin="https://evil.example")) == (403, "access.origin")
    assert ask(app, "/assets/index-1a2b.js", origin="http://localhost").status_code == 200


def test_requests_for_files_are_counted_under_few_names() -> None:
    app = app_with()
    for number in range(20):
        ask(app, f"/assets/{number}.js")
    ask(app, "/")

    text = app.state.backend.observer.metrics.render(ServiceState(ready=True))[0].decode()
    assert 'route="GET /assets/{name}"' in text
    assert 'route="GET /"' in text
    assert "7.js" not in text


def test_gzip_holds_the_same_bytes_every_time(built: Path) -> None:
    first, second = (service.http.static_page._read(built)[0]["/"] for _ in range(2))

    assert first.compressed == second.compressed
    assert first.compressed is not None
    assert gzip.decompress(first.compressed) == INDEX


# What clients say


@pytest.mark.parametrize(
    ("accepted", "takes"),
    [
        ("gzip", True),
        ("GZIP", True),
        ("br;q=1.0, gzip;q=0.8, *;q=0.1", True),
        ("x-gzip", True),
        ("gzip;q=0", False),
        ("gzip; q = 0.000", False),
        ("gzip;q=0.001", True),
        ("identity", False),
        ("*", False),
        ("gzipped", False),
        ("", False),
    ],
)
def test_what_a_client_can_unpack_is_read_from_its_header(accepted: str, takes: bool) -> None:
    assert takes_gzip(Headers({"accept-encoding": accepted})) is takes


@pytest.mark.parametrize(
    ("given", "current"),
    [
        ('"a"', True),
        ('W/"a"', True),
        ('"b", "a"', True),
        ("*", True),
        ('"b"', False),
        ("a", False),
        ('"a', False),
        ("", False),
    ],
)
def test_what_a_client_has_is_read_from_its_header(given: str, current: bool) -> None:
    assert is_current(Headers({"if-none-match": given}), '"a"') is current
