"""examples/web_overlay in Chromium, on another port than the service whose map it draws."""

from __future__ import annotations

import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest

from tests.e2e.test_page import Browser, chromium, missing
from tests.serving import serving

ROOT = Path(__file__).resolve().parents[2]

pytestmark = pytest.mark.skipif(bool(missing()), reason=missing())


@contextmanager
def files_served() -> Iterator[str]:
    """Serve the repository's files, as ``python -m http.server`` does; the origin."""
    handler = partial(SimpleHTTPRequestHandler, directory=str(ROOT))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def test_the_landmarks_are_drawn_where_the_photo_shows_them(
    built_maps: Path, query: Any, tmp_path: Path
) -> None:
    command = ["node", str(ROOT / "web" / "e2e" / "driver.mjs"), str(chromium()), "none"]
    pipe = subprocess.PIPE
    with (
        files_served() as origin,
        serving(built_maps, tmp_path / "log", "--cors-origins", origin) as service,
        subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as driver,
    ):
        browser = Browser(driver, origin)
        seen = browser.see("overlay", service=service, photo=str(query.path))
        driver.communicate(timeout=60)

    assert seen["console"] == []
    hosts = {urlsplit(request["url"].removeprefix("blob:")).netloc for request in seen["requests"]}
    assert hosts - {""} == {urlsplit(origin).netloc, urlsplit(service).netloc}
    np.testing.assert_allclose(seen["overlay"]["position"], query.cam_from_world.center, atol=0.05)
    errors = seen["overlay"]["errors"]
    assert len(errors) > 50
    assert errors[len(errors) // 2] < 2
    assert "pixels" in seen["status"]
