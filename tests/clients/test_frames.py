"""Poses in the frames of AR sessions and robots, against scenes that each framework would see."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from clients import Axes, PoseEstimate, blended, camera_matrix, session_from_map
from service.http.openapi import example
from visloc.errors import InvalidInput
from visloc.geometry import Pose, rotation_angle

Matrix = NDArray[np.float64]

numbers = st.floats(-20, 20)
quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1)


@st.composite
def rigid(draw: Any) -> Matrix:
    pose = Pose.from_quaternion(draw(quaternions), draw(st.tuples(numbers, numbers, numbers)))
    return matrix_of(pose)


def matrix_of(pose: Pose) -> Matrix:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = pose.rotation, pose.translation
    return matrix


def pose_of(matrix: Matrix) -> Pose:
    return Pose(matrix[:3, :3], matrix[:3, 3])


def seen_by(camera_from_frame: Matrix, point: Matrix, axes: Axes) -> Matrix:
    """Where a camera with unit focal length shows a point: right of and below its centre."""
    x, y, z = (camera_from_frame @ [*point, 1])[:3]
    return {
        Axes.OPENCV: np.array([x / z, y / z]),
        Axes.OPENGL: np.array([x / -z, -y / -z]),
        Axes.UNITY: np.array([x / z, -y / z]),
    }[axes]


def in_frame_of(axes: Axes, point: Matrix) -> Matrix:
    return point * [1, 1, -1] if axes is Axes.UNITY else point


@pytest.mark.parametrize("axes", Axes)
@settings(deadline=None)
@given(rigid(), st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(1, 9)))
def test_the_matrix_shows_a_point_of_the_map_where_the_photo_shows_it(
    axes: Axes, cam_from_map: Matrix, beheld: tuple[float, float, float]
) -> None:
    point = (np.linalg.inv(cam_from_map) @ [*beheld, 1])[:3]

    camera_from_map = np.linalg.inv(camera_matrix(pose_of(cam_from_map), axes))

    shown = seen_by(camera_from_map, in_frame_of(axes, point), axes)
    np.testing.assert_allclose(shown, np.array(beheld[:2]) / beheld[2], atol=1e-6)


# Matrices by columns. web/tests/frames.test.ts holds the TypeScript client to the same numbers.
TRUTHS = json.loads(Path(__file__).with_name("frames.json").read_bytes())


@pytest.mark.parametrize("axes", Axes)
@pytest.mark.parametrize("truth", TRUTHS)
def test_the_matrices_are_those_that_both_clients_agree_on(
    axes: Axes, truth: dict[str, Any]
) -> None:
    pose = Pose.from_quaternion(truth["rotation_wxyz"], truth["translation"])
    session_from_camera = np.reshape(truth["session_from_camera"], (4, 4)).T

    matrix = camera_matrix(pose, axes)
    moved = session_from_map(session_from_camera, pose, axes)

    np.testing.assert_allclose(matrix.T.ravel(), truth["camera_matrix"][axes], atol=1e-8)
    np.testing.assert_allclose(moved.T.ravel(), truth["session_from_map"][axes], atol=1e-6)
    if axes is Axes.OPENGL:
        between = blended(session_from_camera, moved, 0.3)
        np.testing.assert_allclose(between.T.ravel(), truth["blended"], atol=1e-6)


@pytest.mark.parametrize("axes", Axes)
@settings(deadline=None)
@given(rigid(), rigid())
def test_the_map_is_found_where_it_lies_in_the_session(
    axes: Axes, cam_from_map: Matrix, truth: Matrix
) -> None:
    pose = pose_of(cam_from_map)
    session_from_camera = truth @ camera_matrix(pose, axes)  # what the device reports

    np.testing.assert_allclose(session_from_map(session_from_camera, pose, axes), truth, atol=1e-6)


@settings(deadline=None)
@given(rigid(), rigid(), rigid())
def test_the_device_may_have_moved_on_when_the_answer_comes(
    cam_from_map: Matrix, truth: Matrix, moved: Matrix
) -> None:
    pose = pose_of(cam_from_map)
    then = truth @ camera_matrix(pose, Axes.OPENGL)
    now = then @ moved

    map_from_device = np.linalg.inv(session_from_map(then, pose, Axes.OPENGL)) @ now

    expected = camera_matrix(pose, Axes.OPENGL) @ moved
    np.testing.assert_allclose(map_from_device, expected, atol=1e-6)


@settings(deadline=None)
@given(rigid(), rigid())
def test_unity_and_opengl_place_the_same_point_of_the_map_alike(
    cam_from_map: Matrix, session_from_camera: Matrix
) -> None:
    mirrored = np.diag([1.0, 1, -1, 1])
    pose, point = pose_of(cam_from_map), np.array([1.0, 2, 3, 1])

    right_handed = session_from_map(session_from_camera, pose, Axes.OPENGL) @ point
    in_unity = session_from_map(mirrored @ session_from_camera @ mirrored, pose, Axes.UNITY)

    np.testing.assert_allclose(in_unity @ (mirrored @ point), mirrored @ right_handed, atol=1e-6)


@settings(deadline=None)
@given(rigid(), rigid())
def test_map_from_odom_is_found_through_ros_optical_frame(
    base_in_map: Matrix, odom_from_map: Matrix
) -> None:
    # REP 103: a base looks along x with z up; its camera's optical frame looks along z.
    base_from_optical = np.array([[0.0, 0, 1, 0.1], [-1, 0, 0, 0], [0, -1, 0, 0.3], [0, 0, 0, 1]])
    map_from_optical = base_in_map @ base_from_optical
    pose = pose_of(np.linalg.inv(map_from_optical))
    odom_from_base = odom_from_map @ base_in_map

    map_from_odom = np.linalg.inv(
        session_from_map(odom_from_base @ base_from_optical, pose, Axes.OPENCV)
    )

    np.testing.assert_allclose(map_from_odom @ odom_from_base, base_in_map, atol=1e-6)


@settings(deadline=None)
@given(rigid(), rigid(), st.floats(0, 1))
def test_blending_goes_straight_from_one_transform_to_the_other(
    old: Matrix, new: Matrix, share: float
) -> None:
    between = blended(old, new, share)

    np.testing.assert_allclose(
        between[:3, 3], (1 - share) * old[:3, 3] + share * new[:3, 3], atol=1e-6
    )
    whole = rotation_angle(old[:3, :3].T @ new[:3, :3])
    part = rotation_angle(old[:3, :3].T @ between[:3, :3])
    assert part == pytest.approx(share * whole, abs=1e-5)


@pytest.mark.parametrize(
    "matrix",
    [
        np.eye(3),
        np.diag([2.0, 2, 2, 1]),
        np.diag([1.0, 1, -1, 1]),
        np.full((4, 4), np.nan),
        np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [3, 2, 1, 1]]),  # by columns
    ],
)
def test_what_is_no_rigid_transform_is_refused(matrix: Matrix) -> None:
    with pytest.raises(InvalidInput, match="rigid") as error:
        session_from_map(matrix, Pose.identity(), Axes.OPENGL)
    assert error.value.code == "frames.not_rigid"
    with pytest.raises(InvalidInput, match="rigid"):
        blended(np.eye(4), matrix, 0.5)


@pytest.mark.parametrize(
    ("metric", "warned"), [(True, False), (False, True), (None, False), ("a pose", False)]
)
def test_a_session_is_warned_of_a_unit_of_unknown_length(metric: Any, warned: bool) -> None:
    answer = example("localized")["pose"]
    pose = PoseEstimate.model_validate(answer | {"metric": None if metric == "a pose" else metric})
    asked = pose.cam_from_world if metric == "a pose" else pose

    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        session_from_map(np.eye(4), asked, Axes.OPENGL)

    assert [str(each.message).partition(" has")[0] for each in told] == (
        ["the unit of this map"] if warned else []
    )
