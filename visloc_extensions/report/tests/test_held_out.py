from __future__ import annotations

import itertools

import numpy as np
import pytest

from mapping.cluster.workers import Workers
from mapping.own_test.held_out import left_out_sets, localize_held_out, vanishing
from mapping.stages.work_folder import WorkFolder
from visloc.localization.map_view.constraints import MapGeometry
from visloc.options import LocalizeOptions
from visloc_extensions.report import held_out
from visloc_extensions.report.held_out import chosen_photos, hold_out


def quiet(*_):
    pass


def runs_of(opened, folder):
    with Workers(1) as workers:
        return hold_out(opened, WorkFolder(folder), workers, quiet)


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
    monkeypatch.setattr("visloc_extensions.report.held_out._COUNTED_PART", 10**9)
    counted = vanishing(half_mapped_room, left_out)
    monkeypatch.setattr("visloc_extensions.report.held_out._COUNTED_PART", 1e-9)
    assert len(counted) > 0
    assert counted.tolist() == vanishing(half_mapped_room, left_out).tolist()


def test_runs_of_another_program_are_not_found_again(half_mapped_room, monkeypatch):
    before = held_out._key(half_mapped_room, 0)
    assert held_out._key(half_mapped_room, 0) == before
    with monkeypatch.context() as patch:
        patch.setattr(held_out, "__version__", "0.0.0")
        assert held_out._key(half_mapped_room, 0) != before
    monkeypatch.setattr(held_out, "LocalizeOptions", lambda: LocalizeOptions(top_k=3))
    assert held_out._key(half_mapped_room, 0) != before


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


def test_runs_get_worse_as_more_is_left_out(half_mapped_room, tmp_path):
    runs = runs_of(half_mapped_room, tmp_path)
    by_photo = [[run for run in runs if run.image == image] for image in range(18)]
    alone = [of_photo[0] for of_photo in by_photo]
    assert all(len(run.left_out) == 1 for run in alone)
    assert all(run.localized for run in alone)
    assert np.median([run.position_error for run in alone]) < 0.02
    hardest = [of_photo[-1] for of_photo in by_photo]
    assert sum(len(r.correct) for r in hardest) < 0.9 * sum(len(r.correct) for r in alone)
    assert sum(r.position_error for r in hardest) > sum(r.position_error for r in alone)


def test_runs_are_found_again_and_equal_to_those_made_anew(half_mapped_room, tmp_path):
    first = runs_of(half_mapped_room, tmp_path / "a")
    files = {path: path.stat().st_mtime_ns for path in (tmp_path / "a").rglob("*.npz")}
    assert len(files) == len(half_mapped_room.images)
    again, anew = (runs_of(half_mapped_room, tmp_path / name) for name in "ab")
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "a").rglob("*.npz")} == files
    for others in (again, anew):
        for one, other in zip(first, others, strict=True):
            assert (one.image, one.reason, one.inliers) == (
                other.image,
                other.reason,
                other.inliers,
            )
            assert one.position_error == other.position_error
            assert one.correct.tolist() == other.correct.tolist()
            assert one.left_out.tolist() == other.left_out.tolist()


def test_an_interrupted_report_makes_only_what_is_missing(half_mapped_room, tmp_path):
    runs_of(half_mapped_room, tmp_path)
    lost = sorted(tmp_path.rglob("*.npz"))[:2]
    for path in lost:
        path.unlink()
    told = []
    with Workers(1) as workers:
        hold_out(half_mapped_room, WorkFolder(tmp_path), workers, lambda *now: told.append(now))
    count = len(half_mapped_room.images)
    assert told[0] == (count - 2, count)
    assert told[-1] == (count, count)
    assert all(path.exists() for path in lost)


def test_a_map_of_one_photo_has_no_runs(make_map, looking, room, tmp_path):
    opened = make_map(room(np.random.default_rng(0), 400), [looking((0.0, 0.0, 0.0), 0.0)])
    assert runs_of(opened, tmp_path) == []


@pytest.mark.parametrize("count", [1, 2, 60, 200, 201, 100_000])
def test_photos_are_chosen_evenly_and_no_more_than_finish_in_minutes(count):
    chosen = chosen_photos(count)
    assert len(chosen) == min(count, 200)
    assert chosen[0] == 0
    assert chosen[-1] == count - 1
    assert max(np.diff(chosen), default=1) <= np.ceil(count / 199)
