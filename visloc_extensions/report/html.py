"""One HTML file that shows a report with nothing around it: no server, no network."""

from __future__ import annotations

import base64
import hashlib
import html
import json
from collections.abc import Mapping
from typing import Any

from visloc.errors import refuse

# In JSON these stand in strings only, where an escape means the same character; without them no
# name of a photo can end the element that it is written into.
_UNSAFE = {ord(character): f"\\u{ord(character):04x}" for character in "<>&"}


def report_page(data: Mapping[str, Any], script: str, style: str) -> str:
    """Return the page that shows a report.

    Args:
        data: a ``ReportData`` as ``web/src/report/data.ts`` has it; numbers must be finite.
        script: the built viewer, which reads the data from the element ``report``.
    """
    script, style = _embeddable(script, "script"), _embeddable(style, "style")
    policy = (
        "default-src 'none'; img-src data: blob:; base-uri 'none'; form-action 'none'; "
        f"script-src '{_source(script)}'; style-src '{_source(style)}'"
    )
    title = f"{data['map']['id']}: coverage of a map"
    # ASCII only, so that neither line separators nor half characters of file names remain.
    values = json.dumps(data, allow_nan=False, separators=(",", ":")).translate(_UNSAFE)
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="referrer" content="no-referrer">
<meta name="color-scheme" content="light dark">
<title>{html.escape(title)}</title>
<style>{style}</style>
</head>
<body>
<noscript>This report draws itself with JavaScript, which is switched off here. \
It loads nothing from anywhere.</noscript>
<script type="application/json" id="report">{values}</script>
<script>{script}</script>
</body>
</html>
"""


def _embeddable(text: str, element: str) -> str:
    """Return a text as a browser reads it back out of the element that it is written into."""
    lowered = text.lower()
    # After <!-- a browser takes <script for the beginning of another one.
    if f"</{element}" in lowered or ("<!--" in lowered and f"<{element}" in lowered):
        raise refuse("page.not_embeddable", element=element)
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _source(text: str) -> str:
    digest = hashlib.sha256(text.encode("utf-8")).digest()
    return f"sha256-{base64.b64encode(digest).decode('ascii')}"
