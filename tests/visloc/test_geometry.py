from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from visloc.errors import InvalidInput
from visloc.geometry import (
    CAMERA_MODELS,
    MAX_IMAGE_SIDE,
    Camera,
    Pose,
    Similarity,
    rotation_angle,
)

unit = st.floats(-1, 1)
quaternions = st.tuples(unit, unit, unit, unit).filter(lambda q: np.linalg.norm(q) > 1e-3)
translations = st.tuples(*[st.floats(-1e6, 1e6)] * 3)
poses = st.builds(Pose.from_quaternion, quaternions, translations)

QUARTER_TURNS = {
    "x": ([1, 1, 0, 0], [[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "y": ([1, 0, 1, 0], [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    "z": ([1, 0, 0, 1], [[0, -1, 0], [1, 0, 0], [0, 0, 1]]),
}


def turn(axis: NDArray[np.float64], angle: float) -> NDArray[np.float64]:
    """Rodrigues' formula, another way to a rotation than the quaternion."""
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation: NDArray[np.float64] = (
        np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    )
    return rotation


@pytest.mark.parametrize("axis", QUARTER_TURNS)
def test_a_quaternion_is_scalar_first_and_turns_by_the_right_hand(axis: str) -> None:
    quaternion, expected = QUARTER_TURNS[axis]
    rotation = Pose.from_quaternion(quaternion, [0, 0, 0]).rotation
    np.testing.assert_allclose(rotation, expected, atol=1e-15)


@given(pose=poses)
def test_a_rotation_is_orthonormal_and_comes_back_from_its_quaternion(pose: Pose) -> None:
    np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(pose.rotation) == pytest.approx(1)
    q = pose.rotation_wxyz
    assert np.linalg.norm(q) == pytest.approx(1)
    assert q[0] >= 0
    again = Pose.from_quaternion(q, pose.translation)
    np.testing.assert_allclose(again.rotation, pose.rotation, atol=2e-15)


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [0, -1, 1]])
@pytest.mark.parametrize("angle", [math.pi, math.pi - 1e-9, math.pi - 1e-3])
def test_half_turns_have_well_scaled_quaternions(axis: list[float], angle: float) -> None:
    rotation = turn(np.array(axis, dtype=float), angle)
    again = Pose.from_quaternion(Pose(rotation, np.zeros(3)).rotation_wxyz, [0, 0, 0])
    np.testing.assert_allclose(again.rotation, rotation, atol=1e-14)


@given(a_from_b=poses, b_from_c=poses, x=translations)
def test_chaining_is_applying_one_after_the_other(
    a_from_b: Pose, b_from_c: Pose, x: tuple[float, float, float]
) -> None:
    point = np.array(x)
    expected = a_from_b.apply(b_from_c.apply(point))
    np.testing.assert_allclose((a_from_b @ b_from_c).apply(point), expected, atol=1e-7)
    np.testing.assert_allclose(b_from_c.inverse().apply(b_from_c.apply(point)), point, atol=1e-7)


@given(pose=poses)
def test_the_center_is_where_frame_a_begins(pose: Pose) -> None:
    np.testing.assert_allclose(pose.apply(pose.center), np.zeros(3), atol=1e-8)
    np.testing.assert_allclose(pose.center, pose.inverse().translation, atol=1e-8)


def test_many_points_are_moved_at_once() -> None:
    pose = Pose.from_quaternion([1, 0, 0, 1], [10, 20, 30])
    points = np.arange(24, dtype=float).reshape(2, 4, 3)
    moved = pose.apply(points)
    assert moved.shape == (2, 4, 3)
    np.testing.assert_allclose(moved[1, 2], pose.apply(points[1, 2]))


def test_identity_changes_nothing() -> None:
    point = np.array([1.0, 2.0, 3.0])
    assert Pose.identity().apply(point).tolist() == [1, 2, 3]
    assert Pose.identity().rotation_wxyz.tolist() == [1, 0, 0, 0]


@pytest.mark.parametrize(
    "quaternion",
    [
        [0, 0, 0, 0],
        [1e-7, 0, 0, 0],
        [math.nan, 0, 0, 1],
        [math.inf, 0, 0, 1],
        [1, 0, 0],
        [1, 0, 0, 0, 0],
        [[1, 0, 0, 0]],
        1.0,
    ],
)
def test_what_is_no_rotation_is_refused(quaternion: list[float]) -> None:
    with pytest.raises(InvalidInput) as caught:
        Pose.from_quaternion(quaternion, [0, 0, 0])
    assert caught.value.code == "pose.rotation"


@pytest.mark.parametrize("translation", [[0, 0], [0, 0, math.nan], [0, 0, -math.inf], 1.0])
def test_what_is_no_translation_is_refused(translation: list[float]) -> None:
    with pytest.raises(InvalidInput) as caught:
        Pose.from_quaternion([1, 0, 0, 0], translation)
    assert caught.value.code == "pose.translation"


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-8, 1e-3, 1.0, 3.0, math.pi - 1e-8, math.pi])
def test_angles_are_exact_near_zero_and_near_a_half_turn(angle: float) -> None:
    rotation = turn(np.array([1.0, -2.0, 0.5]), angle)
    assert rotation_angle(rotation) == pytest.approx(angle, rel=1e-9, abs=1e-15)
    assert rotation_angle(rotation.T) == pytest.approx(angle, rel=1e-9, abs=1e-15)


# Cameras


@pytest.mark.parametrize("model", CAMERA_MODELS)
def test_a_camera_needs_as_many_parameters_as_its_model_has(model: str) -> None:
    count = len(CAMERA_MODELS[model])
    assert Camera(model, 640, 480, (1.0,) * count).params == (1.0,) * count
    for wrong in (count - 1, count + 1, 0):
        with pytest.raises(InvalidInput) as caught:
            Camera(model, 640, 480, (1.0,) * wrong)
        assert caught.value.code == "camera.param_count"
        assert caught.value.expected is not None
        assert ", ".join(CAMERA_MODELS[model]) in caught.value.expected


@pytest.mark.parametrize(
    ("model", "width", "height", "params", "code", "field"),
    [
        ("UNKNOWN_CAMERA", 640, 480, (), "camera.model", "camera.model"),
        ("", 640, 480, (), "camera.model", "camera.model"),
        ("SIMPLE_PINHOLE", 0, 480, (1, 1, 1), "camera.size", "camera.width"),
        ("SIMPLE_PINHOLE", 640, -1, (1, 1, 1), "camera.size", "camera.height"),
        (
            *("SIMPLE_PINHOLE", 640, MAX_IMAGE_SIDE + 1, (1, 1, 1)),
            *("camera.size", "camera.height"),
        ),
        ("SIMPLE_PINHOLE", 640, 480, (0, 1, 1), "camera.param_value", "camera.params"),
        ("SIMPLE_PINHOLE", 640, 480, (-5, 1, 1), "camera.param_value", "camera.params"),
        ("PINHOLE", 640, 480, (1, -1, 1, 1), "camera.param_value", "camera.params"),
        ("PINHOLE", 640, 480, (1, 1, math.nan, 1), "camera.param_value", "camera.params"),
        ("SIMPLE_RADIAL", 640, 480, (1, 1, 1, math.inf), "camera.param_value", "camera.params"),
    ],
)
def test_a_camera_that_cannot_be_is_refused(
    model: str, width: int, height: int, params: tuple[float, ...], code: str, field: str
) -> None:
    with pytest.raises(InvalidInput) as caught:
        Camera(model, width, height, params)
    assert (caught.value.code, caught.value.field) == (code, field)


@pytest.mark.parametrize(
    "text",
    [
        "PINHOLE,640,480,525,526,320,240",
        "PINHOLE 640 480 525 526 320 240",
        "PINHOLE, 640, 480.0, 5.25e2, 526, 320, 240",
    ],
)
def test_a_camera_is_read_from_text(text: str) -> None:
    assert Camera.from_text(text) == Camera("PINHOLE", 640, 480, (525.0, 526.0, 320.0, 240.0))


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("", "camera.syntax"),
        ("PINHOLE", "camera.syntax"),
        ("PINHOLE,640", "camera.syntax"),
        ("PINHOLE,640.5,480,1,1,1,1", "camera.syntax"),
        ("PINHOLE,nan,480,1,1,1,1", "camera.syntax"),
        ("PINHOLE,inf,480,1,1,1,1", "camera.syntax"),
        ("PINHOLE,640,480,f,1,1,1", "camera.syntax"),
        ("PINHOLE,640,480", "camera.param_count"),
        ("PINHOLE,640,480,nan,1,1,1", "camera.param_value"),
        ("PINHOLE,1e300,480,1,1,1,1", "camera.size"),
        ("NOPE,640,480", "camera.model"),
    ],
)
def test_text_that_is_no_camera_is_refused(text: str, code: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        Camera.from_text(text)
    assert caught.value.code == code


def test_the_focal_length_is_the_mean_of_both() -> None:
    assert Camera("PINHOLE", 640, 480, (500, 510, 320, 240)).focal_length == 505
    assert Camera("SIMPLE_RADIAL", 640, 480, (500, 320, 240, 0.1)).focal_length == 500


def test_a_scaled_camera_sees_the_corners_at_the_corners() -> None:
    camera = Camera("OPENCV", 640, 480, (500, 510, 321, 242, 0.1, -0.2, 1e-3, 2e-3))
    assert camera.scaled(320, 120) == Camera(
        "OPENCV", 320, 120, (250, 127.5, 160.5, 60.5, 0.1, -0.2, 1e-3, 2e-3)
    )
    # A ray through pixel (u, v) goes through (u sx, v sy) after resizing: the first centre of a
    # half-size picture is the corner between the first four pixels.
    half = camera.scaled(320, 240)
    x, y = (1.0 - 321) / 500, (1.0 - 242) / 510
    assert half.params[0] * x + half.params[2] == pytest.approx(0.5)
    assert half.params[1] * y + half.params[3] == pytest.approx(0.5)
    assert camera.scaled(640, 480) == camera


@pytest.mark.parametrize(
    ("size", "same"),
    [
        ((640, 480), True),
        ((320, 240), True),
        ((1280, 960), True),
        ((100, 75), True),
        ((101, 76), True),  # rounded to whole pixels
        ((480, 640), False),
        ((640, 360), False),
        ((640, 470), False),
    ],
)
def test_the_aspect_tells_a_resized_picture_from_a_cropped_one(
    size: tuple[int, int], same: bool
) -> None:
    assert Camera("SIMPLE_PINHOLE", 640, 480, (500, 320, 240)).has_aspect_of(*size) is same


def test_the_cameras_of_the_shared_data_are_usable(shared_data: Path) -> None:
    for path in shared_data.glob("*/*/sensors/sensors.txt"):
        for line in path.read_text(encoding="utf-8").splitlines():
            fields = [field.strip() for field in line.split(",")]
            if not line.startswith("#") and fields[2] in ("camera", "depth"):
                assert Camera.from_text(",".join(fields[3:])).width == int(fields[4])


small = st.tuples(*[st.floats(-100, 100)] * 3)
similarities = st.builds(
    lambda scale, q, t: Similarity(scale, Pose.from_quaternion(q, t).rotation, np.array(t)),
    st.floats(0.01, 100),
    quaternions,
    small,
)


@given(similarities, similarities, small)
def test_similarities_chain_and_turn_around(
    a_from_b: Similarity, b_from_c: Similarity, point: tuple[float, float, float]
) -> None:
    x = np.array(point)
    tolerance = 1e-6 * (1 + a_from_b.scale) * (1 + b_from_c.scale)
    assert np.allclose((a_from_b @ b_from_c).apply(x), a_from_b.apply(b_from_c.apply(x)))
    assert np.allclose(a_from_b.inverse().apply(a_from_b.apply(x)), x, atol=1e-6, rtol=1e-6)
    there = a_from_b @ a_from_b.inverse()
    assert np.allclose(there.apply(x), x, atol=tolerance, rtol=1e-6)


@given(similarities, st.builds(Pose.from_quaternion, quaternions, small), small)
def test_a_moved_camera_sees_moved_points_where_it_saw_them(
    a_from_b: Similarity, cam_from_b: Pose, point: tuple[float, float, float]
) -> None:
    x = np.array(point)
    before, after = cam_from_b.apply(x), a_from_b.move(cam_from_b).apply(a_from_b.apply(x))
    assert np.allclose(after, a_from_b.scale * before, atol=1e-6 * (1 + a_from_b.scale))
