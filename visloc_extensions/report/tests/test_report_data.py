from __future__ import annotations

import json

import numpy as np
import pytest

from mapping.cluster.workers import Workers
from mapping.frames.plan import Plan
from mapping.own_test.held_out import HeldOut, Within
from mapping.stages.work_folder import WorkFolder
from visloc.archive import MapStore
from visloc.geometry import Pose
from visloc.localization.map_view.constraints import MapGeometry
from visloc_extensions.report import make_report_data
from visloc_extensions.report.data import calibration_of, decimals_of, rank_correlation_of
from visloc_extensions.report.grid import make_grid
from visloc_extensions.report.statistics import statistics_of


def report_of(opened, folder):
    told = []
    with Workers(1) as workers:
        data = make_report_data(
            opened,
            WorkFolder(folder),
            command="mapping report room",
            workers=workers,
            progress=lambda *now: told.append(now),
        )
    return json.loads(json.dumps(data, allow_nan=False)), told


@pytest.fixture(scope="module", autouse=True)
def few_cells():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("visloc_extensions.report.grid._NUM_CELLS", 40)
        yield


@pytest.fixture(scope="module")
def half_mapped(half_mapped_room, tmp_path_factory):
    return report_of(half_mapped_room, tmp_path_factory.mktemp("work"))


def test_the_report_has_the_shape_that_the_page_reads(half_mapped):
    data, _ = half_mapped
    assert set(data) == {
        *("map", "made_by", "up", "cameras", "images", "statistics", "held_out", "coverage"),
        "look_alikes",
        "look_alikes_asked",
    }
    assert set(data["coverage"]) == {
        *("within", "cell", "right", "ahead", "directions_deg", "pitch_deg", "camera", "cells"),
        *("weak_spots", "calibration", "rank_correlation"),
    }
    assert data["made_by"]["command"] == "mapping report room"
    assert data["up"] == {"direction": [0.0, 0.0, 1.0], "source": "gravity"}
    directions = len(data["coverage"]["directions_deg"])
    for cell in data["coverage"]["cells"]:
        for name in ("probability", "expected_inliers", "position_std"):
            assert len(cell[name]) == directions
        assert all(0 <= value <= 1 for value in cell["probability"])
        assert all(value >= 0 for value in cell["expected_inliers"])
        assert all(value is None or value > 0 for value in cell["position_std"])
    for run in data["held_out"]:
        assert 0 <= run["probability"] <= 1
        assert run["localized"] == (run["reason"] is None) == (run["position_error"] is not None)
    assert data["images"][0] == {
        "name": "0.jpg",
        "camera": "cam",
        "position": [-1.5, -0.8, 0.0],
        "orientation": data["images"][0]["orientation"],
    }


def test_the_orientation_of_an_image_turns_camera_to_world(half_mapped):
    data, _ = half_mapped
    w, x, y, z = data["images"][1]["orientation"]  # looks along the world's x axis
    forward = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]
    assert forward == pytest.approx([1.0, 0.0, 0.0], abs=1e-6)


def test_coverage_is_lower_where_no_photo_looked(half_mapped):
    coverage = half_mapped[0]["coverage"]
    chances = np.array([cell["probability"] for cell in coverage["cells"]])
    directions = coverage["directions_deg"]
    assert coverage["right"] == [1.0, 0.0, 0.0]
    inside = [abs(c["position"][0]) < 1.0 and abs(c["position"][1]) < 1 for c in coverage["cells"]]
    assert sum(inside) >= 3
    towards, away = directions.index(0.0), directions.index(180.0)
    assert chances[inside, towards].min() > 0.8
    assert chances[inside, away].max() < 0.2


def test_weak_spots_say_where_to_look_and_why(half_mapped):
    coverage = half_mapped[0]["coverage"]
    assert 1 <= len(coverage["weak_spots"]) <= 8
    for spot in coverage["weak_spots"]:
        assert spot["probability"] < 0.5
        assert spot["direction_deg"] in coverage["directions_deg"]
        assert abs((spot["direction_deg"] + 180) % 360 - 180) >= 60
        assert len(spot["why"]) > 10


def test_the_report_is_the_same_each_time_and_resumes(half_mapped, half_mapped_room, tmp_path):
    first, _ = half_mapped
    again, told = report_of(half_mapped_room, tmp_path)
    assert again == first
    resumed, told_again = report_of(half_mapped_room, tmp_path)
    assert resumed == first
    count = len(half_mapped_room.images)
    assert ("held-out photos", 0, count) in told
    assert ("held-out photos", count, count) == told_again[0]
    for stage in ("what is found again", "coverage"):
        assert any(now[0] == stage and now[1] == now[2] for now in told)


def test_a_map_of_one_photo_has_a_report_that_says_what_it_rests_on(
    make_map, looking, room, tmp_path
):
    points = room(np.random.default_rng(0), 400)
    data, _ = report_of(make_map(points, [looking((0, 0, 0), 0.0)]), tmp_path)
    assert data["held_out"] == []
    assert data["coverage"]["calibration"] == []
    assert data["coverage"]["rank_correlation"] is None
    assert any("no photo could be held out" in note for note in data["map"]["notes"])
    assert data["coverage"]["cells"]


def test_a_photo_without_observations_does_no_harm(make_map, looking, room, tmp_path):
    points = room(np.random.default_rng(0), 400)
    poses = [looking((0, 0, 0), 0.0), looking((0, 0, 500.0), 0.0), looking((0.1, 0, 0), 0.0)]
    data, _ = report_of(make_map(points, poses), tmp_path)
    blank = [run for run in data["held_out"] if run["image"] == 1]
    assert blank
    assert not any(run["localized"] for run in blank)


def test_ready_made_features_need_no_extractor(make_map, looking, room, tmp_path):
    points = room(np.random.default_rng(0), 800)
    poses = [looking((0.1 * i, 0, 0), 20.0 * i) for i in range(4)]
    data, _ = report_of(make_map(points, poses, ready_made=True, method="sfm"), tmp_path)
    assert data["map"]["local_features"] == "kapture:sift"
    assert any(run["localized"] for run in data["held_out"])


def test_a_built_map_has_a_report(built_maps, tmp_path):
    opened = MapStore(built_maps).open("room")
    data, _ = report_of(opened, tmp_path)
    assert any(run["localized"] for run in data["held_out"])
    # The rig's other camera took a photo at the same instant: it never stays.
    assert min(run["left_out"] for run in data["held_out"]) == 2
    assert data["statistics"]["landmarks_per_image"]["counts"]


def _turned(pose, axes):
    """A pose whose camera is turned: new axes in rows, in the old camera's frame."""
    turn = np.array(axes, dtype=np.float64)
    return Pose(turn @ pose.rotation, turn @ pose.translation)


@pytest.mark.parametrize(
    "axes",
    [
        [[1, 0, 0], [0, 0, -1], [0, 1, 0]],  # straight down
        [[0, -1, 0], [1, 0, 0], [0, 0, 1]],  # on its side
        [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    ],
)
@pytest.mark.parametrize("gravity", [None, (0.0, 0.0, -1.0)])
def test_a_guess_of_what_is_up_is_told_as_such(make_map, looking, tmp_path, axes, gravity):
    points = np.random.default_rng(0).uniform(-3, 3, (800, 3))
    poses = [_turned(looking((0.2 * i, 0, 0), 0.0), axes) for i in range(2)]
    data, _ = report_of(make_map(points, poses, gravity=gravity), tmp_path)
    told = [note for note in data["map"]["notes"] if "--gravity" in note]
    if gravity is None:
        assert data["up"]["source"] == "cameras"
        assert len(told) == 1
        assert "straight down" in told[0]
        assert "on their side" in told[0]
    else:
        assert (data["up"]["source"], told) == ("gravity", [])
        assert data["up"]["direction"] == [0.0, 0.0, 1.0]


@pytest.mark.parametrize(("step", "digits"), [(3.0, 0), (0.3, 1), (0.01, 2), (2e-7, 7), (50.0, 0)])
def test_digits_tell_a_step_apart(step, digits):
    assert decimals_of(step) == digits


def test_places_of_a_small_world_keep_their_digits(make_map, looking, room, tmp_path):
    size = 1e-5
    points = size * room(np.random.default_rng(0), 400)
    poses = [looking((0.5 * size * i, 0, 0), 0.0) for i in range(2)]
    for pose in poses:
        assert np.abs(pose.center).max() < 1e-5
    data, _ = report_of(make_map(points, poses, metric=False, nearest=0.1 * size), tmp_path)
    assert data["images"][1]["position"][0] == pytest.approx(0.5 * size, rel=1e-3)
    assert len({tuple(cell["position"]) for cell in data["coverage"]["cells"]}) > 10


def test_the_grid_stays_near_the_photos_and_at_their_height(half_mapped_room):
    viewpoints = MapGeometry(half_mapped_room).viewpoints
    grid = make_grid(Plan.of(half_mapped_room, viewpoints), viewpoints)
    assert 20 <= len(grid.positions) <= 40
    assert grid.away.max() <= 0.5 * viewpoints.reach + 1e-9
    assert grid.positions[:, 2] == pytest.approx(0.0)


def test_a_long_street_has_no_more_cells_than_a_room(make_map, looking, room):
    points = room(np.random.default_rng(0), 800)
    street = np.concatenate([points + np.array([200.0 * i, 0.0, 0.0]) for i in range(3)])
    poses = [looking((200.0 * i, 0.0, 0.0), 0.0) for i in range(3)]
    opened = make_map(street, poses)
    viewpoints = MapGeometry(opened).viewpoints
    grid = make_grid(Plan.of(opened, viewpoints), viewpoints)
    assert 0 < len(grid.positions) <= 40


def test_statistics_count_every_landmark_and_photo(half_mapped_room):
    found = statistics_of(half_mapped_room)
    assert sum(found["track_length"]["counts"]) == len(half_mapped_room.landmarks)
    assert sum(found["landmarks_per_image"]["counts"]) == len(half_mapped_room.images)
    assert found["error_px"] is None
    assert found["angle_deg"] is None
    for histogram in (found["track_length"], found["landmarks_per_image"]):
        assert len(histogram["edges"]) == len(histogram["counts"]) + 1
        assert (np.diff(histogram["edges"]) > 0).all()


def run_with(error):
    nothing = np.empty(0, dtype=np.int64)
    reason = "" if np.isfinite(error) else "no_pose"
    return HeldOut(0, nothing, reason, error, 0.0, 0, nothing, np.empty(0))


def test_rank_correlation_takes_a_refusal_for_the_worst():
    runs = [run_with(error) for error in (0.01, 0.02, 0.5, np.inf)]
    assert rank_correlation_of(runs, np.array([0.9, 0.8, 0.3, 0.1])) == 1.0
    assert rank_correlation_of(runs, np.array([0.1, 0.3, 0.8, 0.9])) == -1.0
    assert rank_correlation_of(runs, np.full(4, 0.5)) is None
    assert rank_correlation_of(runs[:2], np.array([0.9, 0.8])) is None


def test_calibration_compares_shares_in_bins_of_as_many_runs():
    runs = [run_with(0.0 if i % 4 else np.inf) for i in range(40)]
    bins = calibration_of(runs, np.linspace(0.7, 0.8, 40), Within(0.25, 2.0))
    assert [b["runs"] for b in bins] == [10] * 4
    assert sum(b["measured"] * b["runs"] for b in bins) == pytest.approx(30, abs=0.01)
    assert all(0.7 <= b["predicted"] <= 0.8 for b in bins)
    assert calibration_of(runs[:5], np.zeros(5), Within(0.25, 2.0)) == []
