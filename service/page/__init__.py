"""The built page and report viewer, from the sources in ``web/``; ``make install`` builds them.

``service`` serves the page, ``mapping report`` writes the viewer into its file.
"""

from __future__ import annotations

from pathlib import Path

from visloc.errors import Unavailable, refuse

_BUILT = Path(__file__).parent / "built"


def page_folder() -> Path:
    """Return the folder of the pages: ``index.html`` and others, and all else in ``assets/``."""
    return _built("page", "redoc.html")


def report_parts() -> tuple[str, str]:
    """Return the script and the style sheet of the report."""
    folder = _built("report", "report.js")
    return (folder / "report.js").read_text("utf-8"), (folder / "report.css").read_text("utf-8")


def _built(part: str, first: str) -> Path:
    folder = _BUILT / part
    if not (folder / first).is_file():
        raise refuse(
            "page.not_built",
            (
                "the files of the page are missing: Node.js 20.19 or newer builds them from "
                "web/; wheels and images include them"
            ),
            field=str(folder),
            expected="what `make install` builds where npm is present",
            kind=Unavailable,
        )
    return folder
