from __future__ import annotations

import pytest

from visloc.errors import InvalidInput
from visloc.options import LocalizeOptions


@pytest.mark.parametrize(
    ("options", "least", "before_rivals"),
    [
        (LocalizeOptions(), 0.1, 0.1),
        (LocalizeOptions(min_probability=0.8), 0.8, 0.1),
        (LocalizeOptions(min_probability=0.02), 0.02, 0.02),
        (LocalizeOptions(min_inliers=12), 0.0, 0.0),
        (LocalizeOptions("config2"), 0.0, 0.0),
        (LocalizeOptions("config2", min_probability=0.8), 0.8, 0.1),
    ],
)
def test_the_least_probability_is_the_callers_or_that_of_the_thresholds(
    options: LocalizeOptions, least: float, before_rivals: float
) -> None:
    assert options.least_probability == least
    assert options.before_rivals().least_probability == before_rivals


@pytest.mark.parametrize("value", [-0.1, 1.1, float("nan")])
def test_a_probability_that_is_none_is_refused(value: float) -> None:
    with pytest.raises(InvalidInput) as caught:
        LocalizeOptions(min_probability=value)
    assert caught.value.code == "options.min_probability"
