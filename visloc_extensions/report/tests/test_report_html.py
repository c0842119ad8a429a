from __future__ import annotations

import base64
import hashlib
import json
from html.parser import HTMLParser
from typing import Any

import pytest

from visloc.errors import Unavailable
from visloc_extensions.report.html import report_page

SCRIPT, STYLE = 'document.title += "\u2028é";', "body { color: #123456 }"
HOSTILE = [
    "</script><script>alert(1)</script>",
    "<!--<script>",
    "]]>&lt;\u2028\u2029",
    "half a character \udcff",
    '"quoted" \\ \n',
]


class _Page(HTMLParser):
    """Elements as (name, attributes, text), as a browser tells them apart."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.elements: list[tuple[str, dict[str, str | None], list[str]]] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs), []))

    def handle_data(self, data: str) -> None:
        if self.elements:
            self.elements[-1][2].append(data)

    def handle_endtag(self, tag: str) -> None:
        self.elements.append((f"/{tag}", {}, []))  # what follows is not its text

    def texts(self, name: str) -> list[str]:
        return ["".join(text) for tag, _, text in self.elements if tag == name]


def _data(**changes: Any) -> dict[str, Any]:
    return {"map": {"id": "room"}, "images": [{"name": name} for name in HOSTILE]} | changes


def test_data_arrives_as_it_was_whatever_photos_are_called() -> None:
    page = _Page(report_page(_data(), SCRIPT, STYLE))
    scripts = page.texts("script")
    assert len(scripts) == 2  # no name made another one
    assert json.loads(scripts[0]) == _data()


def test_data_holds_no_character_that_means_something_in_html() -> None:
    text = report_page(_data(), SCRIPT, STYLE)
    inside = text.split('id="report">')[1].split("</script>")[0]
    assert not set("<>&\u2028\u2029") & set(inside)
    assert inside.isascii()


def test_the_title_is_text() -> None:
    text = report_page(_data(map={"id": "<b>&"}), SCRIPT, STYLE)
    assert _Page(text).texts("title") == ["<b>&: coverage of a map"]
    assert "<b>" not in text


def test_the_policy_allows_the_script_and_the_style_that_are_there_and_nothing_else() -> None:
    page = _Page(report_page(_data(), SCRIPT, STYLE))
    (policy,) = (
        attributes["content"]
        for tag, attributes, _ in page.elements
        if tag == "meta" and attributes.get("http-equiv") == "Content-Security-Policy"
    )
    assert policy is not None
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))

    def source(text: str) -> str:
        digest = hashlib.sha256(text.encode()).digest()
        return f"'sha256-{base64.b64encode(digest).decode()}'"

    assert rules == {
        "default-src": "'none'",
        "img-src": "data: blob:",
        "base-uri": "'none'",
        "form-action": "'none'",
        "script-src": source(page.texts("script")[1]),
        "style-src": source(page.texts("style")[0]),
    }


def test_line_ends_are_hashed_as_browsers_read_them() -> None:
    assert report_page(_data(), "a;\r\nb;\rc;", STYLE) == report_page(_data(), "a;\nb;\nc;", STYLE)


def test_nothing_is_loaded_from_anywhere() -> None:
    page = _Page(report_page(_data(), SCRIPT, STYLE))
    assert not [tag for tag, _, _ in page.elements if tag in ("link", "img", "iframe", "base")]
    assert not [a for _, a, _ in page.elements if {"src", "href", "style"} & set(a)]


def test_who_has_no_javascript_is_told() -> None:
    (text,) = _Page(report_page(_data(), SCRIPT, STYLE)).texts("noscript")
    assert "JavaScript" in text


@pytest.mark.parametrize(
    ("script", "style"),
    [
        ('x = "</script>";', STYLE),
        ('x = "</SCRIPT ";', STYLE),
        ('x = "<!-- <script";', STYLE),
        (SCRIPT, "/* </style> */"),
    ],
)
def test_built_files_that_would_end_their_element_are_refused(script: str, style: str) -> None:
    with pytest.raises(Unavailable) as caught:
        report_page(_data(), script, style)
    assert caught.value.code == "page.not_embeddable"


def test_numbers_that_json_has_not_are_refused() -> None:
    with pytest.raises(ValueError, match="JSON compliant"):
        report_page(_data(x=float("nan")), SCRIPT, STYLE)
