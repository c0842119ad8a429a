from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from mapping.cluster.workers import Workers
from mapping.own_test.held_out import HeldOut
from mapping.stages.work_folder import WorkFolder
from visloc.archive import Map
from visloc.localization.map_view.constraints import MapGeometry
from visloc_extensions.report import look_alikes
from visloc_extensions.report.held_out import hold_out
from visloc_extensions.report.look_alikes import Search, find_look_alikes, shares_place

_BETWEEN = 50.0  # from one room to the next; they look past each other
_PER_ROOM = 6


@pytest.fixture(scope="module")
def rooms(make_map: Any, looking: Any, room: Any) -> Any:
    """Make a map of rooms side by side, each photographed alike; those of one kind look alike."""

    def make(kinds: list[int]) -> Map:
        one = room(np.random.default_rng(0), 1200)
        points = [one + np.array([0.0, _BETWEEN * i, 0.0]) for i in range(len(kinds))]
        poses = [
            looking((x, _BETWEEN * i + y, 0.0), 10.0 * y)
            for i in range(len(kinds))
            for x, y in itertools.product((-1.5, -0.5), (-0.8, 0.0, 0.8))
        ]
        look = np.concatenate([np.arange(len(one)) + kind * len(one) for kind in kinds])
        opened: Map = make_map(np.concatenate(points), poses, look=look)
        return opened

    return make


def found_in(opened: Map, folder: Any) -> tuple[Search, list[HeldOut]]:
    work, told = WorkFolder(folder), list[tuple[int, int]]()
    with Workers(1) as workers:
        runs = hold_out(opened, work, workers, lambda *_: None)
        found = find_look_alikes(
            opened,
            MapGeometry(opened).viewpoints,
            runs,
            work,
            workers,
            lambda *now: told.append(now),
        )
    assert told[-1] == (len(opened.images),) * 2
    return found, runs


def test_two_rooms_that_look_alike_are_named_once(rooms: Any, tmp_path: Any) -> None:
    opened = rooms([0, 1, 0])
    found, runs = found_in(opened, tmp_path)
    (pair,) = found.found
    assert found.asked == len(opened.images)
    assert {pair.image // _PER_ROOM, pair.twin // _PER_ROOM} == {0, 2}
    viewpoints = MapGeometry(opened).viewpoints
    away = viewpoints.centers[pair.twin] - viewpoints.centers[pair.image]
    assert abs(away[1]) == pytest.approx(2 * _BETWEEN, abs=2.0)
    expected = viewpoints.centers[pair.image] + np.array(
        [0.0, np.sign(away[1]) * 2 * _BETWEEN, 0.0]
    )
    assert pair.position == pytest.approx(expected, abs=0.1)
    assert pair.inliers >= 30
    own = next(run for run in runs if run.image == pair.image)
    assert pair.own_inliers == len(own.correct) > 30
    assert pair.told(opened) == (
        f"photos around {pair.image}.jpg look like those around {pair.twin}.jpg: {pair.image}.jpg "
        f"has {pair.inliers} inliers there, and {pair.own_inliers} at its own place"
    )


def test_what_was_found_is_found_again(rooms: Any, tmp_path: Any, monkeypatch: Any) -> None:
    opened = rooms([0, 0])
    (first,) = found_in(opened, tmp_path)[0].found
    monkeypatch.setattr(look_alikes, "_ask", None)  # would fail if anything were asked
    (again,) = found_in(opened, tmp_path)[0].found
    assert again.told(opened) == first.told(opened)
    assert again.position.tolist() == first.position.tolist()


def test_rooms_that_look_different_are_not_named(rooms: Any, tmp_path: Any) -> None:
    opened = rooms([0, 1, 2])
    search, _ = found_in(opened, tmp_path)
    assert (search.found, search.asked) == ((), len(opened.images))


def test_of_a_map_of_one_place_no_photo_can_be_asked(rooms: Any, tmp_path: Any) -> None:
    search, _ = found_in(rooms([0]), tmp_path)
    assert (search.found, search.asked) == ((), 0)


def test_a_room_that_is_half_mapped_does_not_look_like_itself(
    half_mapped_room: Map, tmp_path: Any
) -> None:
    search, _ = found_in(half_mapped_room, tmp_path)
    assert search.found == ()
    assert search.asked > 0


def test_more_pairs_than_anyone_reads_are_not_told(
    rooms: Any, tmp_path: Any, monkeypatch: Any
) -> None:
    monkeypatch.setattr(look_alikes, "_MOST", 1)
    found, _ = found_in(rooms([0, 1, 0, 1]), tmp_path)
    assert len(found.found) == 1


def test_photos_that_share_a_landmark_share_a_place_however_far_they_are_apart(
    make_map: Any, looking: Any, room: Any
) -> None:
    points = room(np.random.default_rng(0), 400)
    points = np.concatenate([points, points + np.array([0.0, 50.0, 0.0])])
    places = [((0, 0, 0), 0), ((-2.5, 1.8, 0), -35), ((0, 0, 0), 80), ((0, 50, 0), 0)]
    opened = make_map(points, [looking(position, yaw) for position, yaw in places])
    viewpoints = MapGeometry(opened).viewpoints
    assert viewpoints.apart_from(viewpoints.pose(0))[1:].min() > 1.2
    assert shares_place(opened, viewpoints, 0).tolist() == [True, True, False, False]
