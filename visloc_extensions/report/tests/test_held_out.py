from __future__ import annotations

import numpy as np
import pytest

from mapping.cluster.workers import Workers
from mapping.stages.work_folder import WorkFolder
from visloc.options import LocalizeOptions
from visloc_extensions.report import held_out
from visloc_extensions.report.held_out import chosen_photos, hold_out


def quiet(*_):
    pass


def runs_of(opened, folder):
    with Workers(1) as workers:
        return hold_out(opened, WorkFolder(folder), workers, quiet)


def test_runs_of_another_program_are_not_found_again(half_mapped_room, monkeypatch):
    before = held_out._key(half_mapped_room, 0)
    assert held_out._key(half_mapped_room, 0) == before
    with monkeypatch.context() as patch:
        patch.setattr(held_out, "__version__", "0.0.0")
        assert held_out._key(half_mapped_room, 0) != before
    monkeypatch.setattr(held_out, "LocalizeOptions", lambda: LocalizeOptions(top_k=3))
    assert held_out._key(half_mapped_room, 0) != before


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
