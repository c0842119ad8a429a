"""The report in Chromium (scenario: web/e2e/)."""

from __future__ import annotations

from pathlib import Path

from tests.e2e.test_page import Browser, grouped, pytestmark  # noqa: F401
from visloc.archive import MapStore
from visloc_extensions.report.command import write_report


def test_the_report_of_a_map_needs_nothing_but_its_file(
    browser: Browser, built_maps: Path, tmp_path: Path
) -> None:
    opened, file = MapStore(built_maps).open("room"), tmp_path / "room.html"
    write_report(
        *(opened, file, tmp_path), workers=1, command=["mapping"], progress=lambda *_: None
    )

    seen = browser.see("report", file=file.as_uri())

    inside = ("data:", "blob:")
    asked = [request["url"] for request in seen["requests"]]
    assert [url for url in asked if not url.startswith(inside)] == [file.as_uri()]
    assert seen["console"] == seen["violations"] == seen["dialogs"] == []
    assert seen["cells"] > 10
    assert "8 of 8" in seen["shown"] or "100\N{NO-BREAK SPACE}%" in seen["shown"]
    assert f"{grouped(len(opened.landmarks))} landmarks" in seen["described"]  # the view, in words
    assert seen["faults"] == []
