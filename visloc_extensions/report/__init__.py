"""``mapping report``: what a map holds, and where it localizes."""

from __future__ import annotations

from visloc_extensions.report.data import make_report_data

__all__ = ["make_report_data"]
