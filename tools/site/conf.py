"""Sphinx's settings. Its source is the repository's root: README.md and others there are pages."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel
from sphinx.application import Sphinx

import visloc
from tools.site.grpc_reference import grpc_reference
from tools.site.http_reference import http_reference

project = "visloc"
author = "the visloc authors"
release = visloc.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
source_suffix = {".md": "markdown"}
include_patterns = [
    *("*.md", "docs/**", "visloc_extensions/*/README.md"),
    *("examples/plugin/README.md", "web/client/README.md"),
]
exclude_patterns = ["maps"]
root_doc = "docs/index"
html_theme = "furo"
html_title = f"visloc {release}"
html_extra_path = ["index.html"]  # leads to docs/index.html
html_copy_source = False
autodoc_typehints = "description"
autodoc_member_order = "bysource"
autodoc_default_options = {"exclude-members": "model_config"}
myst_heading_anchors = 4

_MADE = {"docs/reference/http": http_reference, "docs/reference/grpc": grpc_reference}


def setup(app: Sphinx) -> None:
    """Fill the pages that are made of other sources."""

    def fill(_: Sphinx, page: str, source: list[str]) -> None:
        if page in _MADE:
            source[0] += "\n" + _MADE[page]()

    app.connect("source-read", fill)
    app.connect("autodoc-process-signature", _without_data)
    app.connect("autodoc-process-docstring", _with_fields)


def _is_model(what: str, thing: Any) -> bool:
    return what == "class" and issubclass(thing, BaseModel)


def _without_data(
    _app: Sphinx, what: str, _name: str, thing: Any, *_: Any
) -> tuple[str, None] | None:
    """Leave out pydantic's ``(**data)``."""
    return ("", None) if _is_model(what, thing) else None


def _with_fields(
    _app: Sphinx, what: str, _name: str, thing: Any, _options: Any, lines: list[str]
) -> None:
    """List the fields of a pydantic model, which autodoc does not see."""
    if _is_model(what, thing):
        for name, field in thing.model_fields.items():
            lines += ["", f":ivar {name}: {field.description or ''}"]
