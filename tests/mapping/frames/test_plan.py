from __future__ import annotations

import numpy as np
import pytest

from mapping.frames.plan import Plan
from visloc.geometry import Pose
from visloc.localization.map_view.constraints import MapGeometry


def test_up_is_a_direction_even_where_no_row_tells_which_way_round(make_map):
    # Rows level and upper edges at right angles to what is most nearly level.
    axes = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    poses = [Pose(turn @ axes, np.zeros(3)) for turn in (np.eye(3), np.diag([-1.0, 1, -1]))]
    points = np.random.default_rng(0).uniform(-3, 3, (400, 3))
    opened = make_map(points, poses, gravity=None)
    plan = Plan.of(opened, MapGeometry(opened).viewpoints)
    for axis in (plan.up, plan.right, plan.ahead):
        assert np.linalg.norm(axis) == pytest.approx(1.0)


def test_without_gravity_up_is_that_of_the_cameras(make_map, looking, room):
    points = room(np.random.default_rng(0), 200)
    opened = make_map(points, [looking((0, 0, 0), 40.0 * i) for i in range(3)], gravity=None)
    plan = Plan.of(opened, MapGeometry(opened).viewpoints)
    assert plan.up_source == "cameras"
    assert plan.up == pytest.approx([0.0, 0.0, 1.0], abs=1e-9)
    assert np.cross(plan.right, plan.ahead) == pytest.approx(plan.up)
    assert plan.pitch_deg == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("quarter_turns", [0, 1, 2, 3])
def test_the_plan_holds_the_camera_as_the_mapping_photos_did(
    make_map, looking, room, quarter_turns
):
    turn = np.linalg.matrix_power(np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]), quarter_turns)
    poses = []
    for yaw in (0.0, 30.0, 60.0):
        level = looking((0, 0, 0), yaw)
        poses.append(type(level)(turn @ level.rotation, turn @ level.translation))
    opened = make_map(room(np.random.default_rng(0), 800), poses)
    plan = Plan.of(opened, MapGeometry(opened).viewpoints)
    made = plan.pose(np.zeros(3), 30.0)
    assert made.rotation == pytest.approx(poses[1].rotation, abs=1e-9)
    assert np.linalg.det(made.rotation) == pytest.approx(1.0)


def test_a_pose_of_the_plan_looks_where_it_says(make_map, looking, room):
    opened = make_map(room(np.random.default_rng(0), 200), [looking((0, 0, 0), 0.0)])
    plan = Plan.of(opened, MapGeometry(opened).viewpoints)
    position = np.array([1.0, 2.0, 0.3])
    pose = plan.pose(position, 90.0)
    assert pose.center == pytest.approx(position)
    assert pose.rotation[2] == pytest.approx(plan.ahead)
