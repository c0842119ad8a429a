from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from visloc.archive import SetOutline
from visloc.geometry import Pose
from visloc.sequences.filling import Odometry
from visloc.sets.handover import Track

SURE = np.diag([1e-6] * 3 + [1e-4] * 3)
REACH = 2.0  # tiles are tied to 0.2 of it


def at(*center: float, turn: float = 0.0) -> Pose:
    rotation = Rotation.from_euler("z", turn, degrees=True).as_matrix()
    return Pose(rotation, -rotation @ np.array(center))


def track(metre: float | None = 1.0, odometry: Pose | None = None) -> Track:
    given = None if odometry is None else Odometry(odometry, None)
    return Track.begun(0, at(0, 0, 0), SURE, metre, given)


def test_a_device_is_where_its_odometry_has_it() -> None:
    # In a world of the tracker's own, and a set of half metres.
    of_tracker = at(7, 8, 9, turn=40.0)
    begun = track(2.0, of_tracker)
    for step in (at(1, 0, 0), at(3, 0, 0, turn=20.0)):
        moved = begun.moved(Odometry(step @ of_tracker, None))
        assert moved.knows_motion
        there = Pose(step.rotation, 2.0 * step.translation)
        assert moved.allows(there, SURE, 0.1, REACH)
        for wrong in (at(0, 0, 0), at(60, 0, 0), at(*there.center, turn=90.0)):
            assert not moved.allows(wrong, SURE, 0.1, REACH)


def test_motion_adds_up_and_grows_less_certain() -> None:
    steps = [at(float(i), 0, 0) for i in range(11)]
    moved = track(1.0, steps[0])
    widths = []
    for step in steps[1:]:
        moved = moved.moved(Odometry(step, None))
        widths.append(np.trace(moved.drift))
    assert moved.allows(at(10, 0, 0), SURE, 1.0, REACH)
    assert not moved.allows(at(8, 0, 0), SURE, 1.0, REACH)
    assert np.all(np.diff(widths) > 0)
    # A tracker that says how unsure it is may be further off.
    unsure = track(1.0, steps[0]).moved(Odometry(steps[10], np.diag([1e-4] * 3 + [1.0] * 3)))
    assert unsure.allows(at(8, 0, 0), SURE, 1.0, REACH)


def test_without_odometry_a_device_is_no_faster_than_a_car() -> None:
    for unknown in (track(), track(1.0, at(0, 0, 0)).moved(None)):
        assert not unknown.knows_motion
        assert unknown.allows(at(2, 0, 0), SURE, 0.1, REACH)
        assert not unknown.allows(at(160, 0, 0), SURE, 0.1, REACH)
    nowhere = track(None)
    assert nowhere.allows(at(0.2, 0, 0), SURE, 0.1, REACH)
    assert not nowhere.allows(at(2, 0, 0), SURE, 0.1, REACH)


def test_the_area_of_a_device_holds_where_it_is(outline: Callable[..., SetOutline]) -> None:
    houses: Any = outline([((0, 0, 0), (1, 1, 1))], reach=REACH)
    area = track(1.0, at(0, 0, 0)).moved(Odometry(at(5, 0, 0), None)).area(houses)
    assert area.position == pytest.approx([5, 0, 0])
    assert 0.2 < area.radius < 1.0
