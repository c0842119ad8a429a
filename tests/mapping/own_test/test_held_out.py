from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from mapping.own_test.held_out import (
    HeldOut,
    Within,
    left_out_sets,
    localize_held_out,
    tolerance_of,
    vanishing,
)
from visloc.localization.map_view.constraints import MapGeometry


def test_each_photo_is_left_out_first_alone_and_then_with_ever_more_of_its_neighbours(
    half_mapped_room,
):
    viewpoints = MapGeometry(half_mapped_room).viewpoints
    sets = left_out_sets(half_mapped_room, viewpoints, 4)
    assert sets[0].tolist() == [4]
    assert all(set(a) < set(b) for a, b in itertools.pairwise(sets))
    assert len(sets[-1]) < len(half_mapped_room.images)
    apart = viewpoints.apart_from(viewpoints.pose(4))
    for left_out in sets:
        kept = np.setdiff1d(np.arange(len(apart)), left_out)
        assert apart[kept].min() >= apart[left_out].max()


def test_photos_of_the_same_instant_of_a_rig_go_together(make_map, looking, room):
    poses = [looking((0.1 * i, 0.0, 0.0), 60.0 * i) for i in range(4)]
    opened = make_map(
        room(np.random.default_rng(0), 400),
        poses,
        cameras=["left", "right", "left", "right"],
        timestamps=[0, 0, 1, 1],
        rigs={"rig": {"left": poses[0], "right": poses[0]}},
    )
    first = left_out_sets(opened, MapGeometry(opened).viewpoints, 2)[0]
    assert first.tolist() == [2, 3]


def test_photos_of_one_camera_do_not_go_together_for_a_clock_that_stands_still(
    make_map, looking, room
):
    poses = [looking((0.0, 0.0, 0.0), 90.0 * i) for i in range(3)]
    opened = make_map(room(np.random.default_rng(0), 400), poses, timestamps=[7, 7, 7])
    assert left_out_sets(opened, MapGeometry(opened).viewpoints, 0)[0].tolist() == [0]


def test_landmarks_that_too_few_remaining_photos_see_vanish(make_map, looking):
    wall = np.column_stack([np.full(50, 3.0), np.linspace(-1, 1, 50), np.zeros(50)])
    poses = [looking((0.0, 0.1 * i, 0.0), 0.0) for i in range(3)]
    by_depth, by_matches = make_map(wall, poses), make_map(wall, poses, method="sfm")
    assert len(vanishing(by_depth, np.array([0, 1]))) == 0
    assert len(vanishing(by_matches, np.array([0]))) == 0
    assert vanishing(by_matches, np.array([0, 1])).tolist() == list(range(50))


def test_what_vanishes_is_the_same_counted_and_sorted(half_mapped_room, monkeypatch):
    left_out = np.arange(0, 18, 2)
    monkeypatch.setattr("mapping.own_test.held_out._COUNTED_PART", 10**9)
    counted = vanishing(half_mapped_room, left_out)
    monkeypatch.setattr("mapping.own_test.held_out._COUNTED_PART", 1e-9)
    assert len(counted) > 0
    assert counted.tolist() == vanishing(half_mapped_room, left_out).tolist()


def test_nothing_is_matched_that_only_photos_left_out_saw(make_map, looking):
    # Photo 1 is photo 0 again; photo 2 sees other points, in the same direction but elsewhere.
    random = np.random.default_rng(1)
    here = np.column_stack([np.full(200, 3.0), random.uniform(-1, 1, (200, 2))])
    there = here + np.array([0.0, 50.0, 0.0])
    poses = [looking((0.0, 0.0, 0.0), 0.0)] * 2 + [looking((0.0, 50.0, 0.0), 0.0)]
    opened = make_map(np.concatenate([here, there]), poses)
    viewpoints = MapGeometry(opened).viewpoints
    with_its_double = localize_held_out(opened, viewpoints, 0, np.array([0]))
    assert with_its_double.localized
    assert with_its_double.position_error < 0.05
    assert len(with_its_double.correct) > 100
    alone = localize_held_out(opened, viewpoints, 0, np.array([0, 1]))
    assert not alone.localized
    assert len(alone.correct) == 0
    assert alone.reason in ("too_few_matches", "no_pose", "too_few_inliers", "uncertain_pose")


def test_a_duplicate_of_a_photo_is_left_out_with_it_in_the_second_run(make_map, looking, room):
    poses = [looking((0.0, 0.0, 0.0), yaw) for yaw in (0.0, 0.0, 180.0)]
    opened = make_map(room(np.random.default_rng(0), 800), poses)
    sets = left_out_sets(opened, MapGeometry(opened).viewpoints, 0)
    assert [s.tolist() for s in sets] == [[0], [0, 1]]


@pytest.mark.parametrize(
    ("scale", "metric", "of_reach"),
    [(1.0, True, None), (1.0, False, 0.05), (1 / 60, True, 0.2), (800.0, True, 0.01)],
)
def test_a_tolerance_is_25_cm_within_shares_of_what_is_seen_in_metric_maps(
    make_map, looking, room, scale, metric, of_reach
):
    poses = [looking((0.0, 0.0, 0.0), 90.0 * i) for i in range(3)]
    opened = make_map(room(np.random.default_rng(0), 400), poses, metric=metric)
    viewpoints = MapGeometry(opened).viewpoints
    viewpoints = replace(viewpoints, reach=scale * viewpoints.reach)
    expected = 0.25 if of_reach is None else of_reach * viewpoints.reach
    assert tolerance_of(opened, viewpoints) == Within(expected, 2.0)


def test_a_run_is_judged_by_position_and_orientation():
    def run(position, orientation):
        nothing = np.empty(0, dtype=np.int64)
        return HeldOut(0, nothing, "", position, orientation, 9, nothing, np.empty(0))

    within = Within(0.25, 2.0)
    assert within.holds(run(0.25, 2.0))
    assert not within.holds(run(0.26, 0.0))
    assert not within.holds(run(0.0, 2.1))
    assert not within.holds(run(np.inf, np.inf))
