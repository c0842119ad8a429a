"""Maps of boards in space, as the tests of the report have them."""

from __future__ import annotations

from tests.mapping.report.conftest import looking, make_map, room

__all__ = ["looking", "make_map", "room"]
