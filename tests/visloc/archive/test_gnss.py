"""GNSS fixes that a map keeps."""

from __future__ import annotations

from dataclasses import replace

import pytest
from pydantic import ValidationError

from visloc.archive.gnss import Fixes, GnssFix


def fix(timestamp: int, receiver: str = "gps", x: float = 8.1) -> GnssFix:
    return GnssFix(timestamp=timestamp, receiver=receiver, x=x, y=48.2, z=410.0, utc=0.0, dop=1.5)


def fixes(*some: GnssFix, system: str = "EPSG:4326") -> Fixes:
    return Fixes(receivers={each.receiver: (system,) for each in some}, fixes=some)


def test_the_fixes_of_two_captures_of_one_receiver_follow_each_other() -> None:
    both = fixes(fix(1), fix(2)).joined(fixes(fix(2), fix(3)))
    assert both == fixes(fix(1), fix(2), fix(3))


@pytest.mark.parametrize(
    "other", [fixes(fix(2, x=9.0), fix(3)), fixes(fix(3), system="EPSG:25832")]
)
def test_receivers_of_one_name_that_contradict_each_other_are_two(other: Fixes) -> None:
    first = fixes(fix(1), fix(2))
    both = first.joined(other)
    assert both.receivers == {"gps": ("EPSG:4326",), "gps-2": other.receivers["gps"]}
    renamed = [replace(each, receiver="gps-2") for each in other.fixes]
    assert both.fixes == (*first.fixes, *renamed)


def test_a_fix_needs_its_receiver() -> None:
    with pytest.raises(ValidationError, match="not listed"):
        Fixes(receivers={}, fixes=(fix(1),))


def test_a_receiver_has_one_fix_at_a_time() -> None:
    with pytest.raises(ValidationError, match="one receiver and time"):
        fixes(fix(1), fix(1, x=9.0))


def test_too_many_fixes_are_thinned_for_each_receiver_alike() -> None:
    many = fixes(*(fix(time, receiver) for time in range(10) for receiver in ("a", "b")))
    assert many.thinned(20) is many
    few = many.thinned(7)
    assert few.receivers == many.receivers
    assert [(each.receiver, each.timestamp) for each in few.fixes] == [
        *[("a", time) for time in (0, 3, 6, 9)],
        *[("b", time) for time in (2, 5, 8)],
    ]
