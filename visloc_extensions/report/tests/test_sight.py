from __future__ import annotations

import numpy as np
import pytest

from visloc.geometry import Camera
from visloc.localization.map_view.constraints import MapGeometry
from visloc_extensions.report.places import sample_places
from visloc_extensions.report.sight import Absent, look_around

CAMERA = Camera("PINHOLE", 320, 240, (220.0, 220.0, 160.0, 120.0))


@pytest.fixture(scope="module")
def wall_map(make_map, looking):
    """A wall at x = 3, seen by one photo from 3 m and one from 1.5 m to the left of it."""
    random = np.random.default_rng(0)
    wall = np.column_stack([np.full(150, 3.0), random.uniform(-1, 1, (150, 2))])
    return make_map(wall, [looking((0.0, 0.0, 0.0), 0.0), looking((1.5, 0.8, 0.0), 0.0)])


def sight_at(opened, pose, camera=CAMERA, absent=None):
    viewpoints = MapGeometry(opened).viewpoints
    return look_around(sample_places(opened, viewpoints), viewpoints, pose, camera, absent)


def test_a_camera_that_faces_the_wall_has_it_in_view(wall_map, looking):
    sight = sight_at(wall_map, looking((0.0, 0.0, 0.0), 0.0))
    assert len(sight) == len(sample_places(wall_map, MapGeometry(wall_map).viewpoints).points)
    assert sight.angles_deg == pytest.approx(0.0, abs=1e-4)
    assert sight.octaves == pytest.approx(0.0, abs=1e-6)
    assert (sight.observers >= 1).all()
    assert (sight.observers == 2).any()
    assert np.linalg.norm(sight.rays, axis=1) == pytest.approx(1.0)
    assert sight.apart == pytest.approx(0.0, abs=1e-6)


def test_a_camera_that_faces_away_has_nothing_in_view(wall_map, looking):
    assert len(sight_at(wall_map, looking((0.0, 0.0, 0.0), 180.0))) == 0


def test_angle_and_distance_are_those_between_photo_and_pose(make_map, looking):
    spot = np.array([[3.0, 0.0, 0.0], [3.0, 0.0, 0.5]])
    opened = make_map(spot, [looking((0.0, 0.0, 0.0), 0.0)])
    sight = sight_at(opened, looking((3.0 - 6.0 * np.cos(0.5), -6.0 * np.sin(0.5), 0.0), 28.6))
    assert sight.angles_deg[0] == pytest.approx(np.degrees(0.5), abs=1.0)
    assert sight.octaves[0] == pytest.approx(1.0, abs=0.02)
    assert sight.distances[0] == pytest.approx(6.0, abs=0.05)


def test_of_two_photos_the_one_counts_that_saw_a_place_more_alike(wall_map, looking):
    near = sight_at(wall_map, looking((1.5, 0.8, 0.0), 0.0))
    assert near.octaves == pytest.approx(0.0, abs=1e-6)
    gone = Absent(np.array([1]), np.empty(0, dtype=np.int64))
    without = sight_at(wall_map, looking((1.5, 0.8, 0.0), 0.0), absent=gone)
    assert (without.octaves < -0.4).all()
    assert (without.observers == 1).all()


def test_landmarks_thought_away_are_not_in_view(wall_map, looking):
    everything = Absent(np.array([1]), np.arange(len(wall_map.landmarks)))
    assert len(sight_at(wall_map, looking((0.0, 0.0, 0.0), 0.0), absent=everything)) == 0


def test_what_stands_behind_is_told_by_its_depth(make_map, looking):
    random = np.random.default_rng(0)
    front = np.column_stack([np.full(80, 2.0), random.uniform(-0.5, 0.5, (80, 2))])
    opened = make_map(np.concatenate([front, front * 4.0]), [looking((0.0, 0.0, 0.0), 0.0)])
    sight = sight_at(opened, looking((0.0, 0.0, 0.0), 0.0))
    is_far = sight.distances > 6.0
    assert sight.behind[~is_far] == pytest.approx(0.0, abs=1e-6)
    assert np.median(sight.behind[is_far]) == pytest.approx(2.0, abs=0.01)


def test_points_beyond_the_border_do_not_come_back_by_distortion(make_map, looking):
    # Strong barrel distortion turns back on itself: a point 70 degrees aside projects inside.
    bent = Camera("SIMPLE_RADIAL", 320, 240, (220.0, 160.0, 120.0, -0.35))
    aside = np.array([[1.0, 2.7, 0.0], [1.0, 2.8, 0.01], [3.0, 0.0, 0.0]])
    opened = make_map(aside, [looking((0.0, 0.0, 0.0), 70.0), looking((0.0, 0.0, 0.0), 0.0)])
    sight = sight_at(opened, looking((0.0, 0.0, 0.0), 0.0), bent)
    assert sight.distances.tolist() == pytest.approx([3.0])


def test_landmarks_of_one_corner_are_one_place(make_map, looking):
    corner = np.array([[3.0, 0.0, 0.0], [3.0, 0.0005, 0.0], [3.0, 0.5, 0.0]])
    opened = make_map(corner + 0.001, [looking((0.0, 0.0, 0.0), 0.0)])
    assert len(sample_places(opened, MapGeometry(opened).viewpoints).points) == 2


def test_a_sample_of_places_stands_for_all(make_map, looking, room):
    points = room(np.random.default_rng(0), 9000)
    opened = make_map(points, [looking((0.0, 0.0, 0.0), 90.0 * i) for i in range(4)])
    places = sample_places(opened, MapGeometry(opened).viewpoints)
    assert places.share < 0.5
    everything = len(np.unique(np.floor(opened.landmarks / 0.03), axis=0))
    assert len(places.points) / places.share == pytest.approx(everything, rel=0.25)
    again = sample_places(opened, MapGeometry(opened).viewpoints)
    assert again.points.tolist() == places.points.tolist()
    rows, photos = places.rows(np.array([2, 0]))
    assert photos.tolist() == sorted(photos.tolist(), reverse=True)
    assert (places.of_landmark[places.landmarks[rows]] == places.seen[rows]).all()
