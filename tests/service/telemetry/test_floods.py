from __future__ import annotations

import pytest

from service.telemetry import floods
from service.telemetry.floods import Floods


def test_of_a_flood_the_first_lines_are_written_and_the_others_are_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = 1000.0
    monkeypatch.setattr(floods, "monotonic", lambda: now)
    seen = Floods()
    assert [seen.passes("slow") for _ in range(20)] == [(True, 0)] * 20
    assert [seen.passes("slow") for _ in range(7)] == [(False, 0)] * 7
    assert seen.passes("gone") == (True, 0)  # each kind for itself
    now += 59.0
    assert seen.passes("slow") == (False, 0)
    now += 1.0
    assert seen.passes("slow") == (True, 8)
    assert seen.passes("slow") == (True, 0)
    now += 60.0
    assert seen.passes("slow") == (True, 0)
