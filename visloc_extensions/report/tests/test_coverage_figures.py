"""The tables of the coverage benchmark, of queries that are made up."""

from __future__ import annotations

import math

import pytest

from benchmarks.coverage import Outcome, print_table
from mapping.own_test.held_out import Within


def test_predictors_are_ranked_by_what_came(capsys: pytest.CaptureFixture[str]) -> None:
    errors = (0.01, 0.02, 0.03, 0.04, 1.0, math.inf)
    outcomes = [
        Outcome(
            f"{i}.jpg",
            position_error=error,
            orientation_error_deg=error,
            inliers=100 - i,
            expected_inliers=100.0 - i,
            position_std=0.01 * (i + 1),
            probability=0.9 - 0.1 * i,
            photo_away=0.5,
            photo_turned_deg=float(-i),
            photo_apart=float(i % 2),
        )
        for i, error in enumerate(errors)
    ]

    print_table(outcomes, Within(0.25, 2.0))

    told = capsys.readouterr().out
    assert "6 queries, 5 localized, 4 within 0.25 and 2 degrees; predicted 3.9" in told
    for name in ("1 - probability", "expected inliers, fewest first", "position_std"):
        assert f"| {name} | 1.00 | 0 | 1.00 | 0 | 1.00 |" in told.replace("1e-24", "0")
    assert "| angle to a photo | -1.00 |" in told
    assert "| distance to the nearest photo | - | - | - | - | 0.50 |" in told
    assert "| 5.jpg | inf | inf | 95 | 0.400 | 1 of 6 |" in told
