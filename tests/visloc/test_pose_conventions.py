from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from visloc.geometry import Pose, rotation_angle
from visloc.pose_conventions import READINGS, UNIT_READINGS

ALL = READINGS | UNIT_READINGS
OPENGL = "with OpenGL axes (x right, y up, z backward)"


def poses(seed: int, count: int = 6) -> list[Pose]:
    rng = np.random.default_rng(seed)
    rotations = Rotation.random(count, rng=rng).as_matrix()
    return [
        Pose(r, t) for r, t in zip(rotations, 1000.0 * rng.normal(size=(count, 3)), strict=True)
    ]


def from_matrix(matrix: np.ndarray) -> Pose:  # type: ignore[type-arg]
    return Pose(matrix[:3, :3], matrix[:3, 3])


def matrix_of(pose: Pose) -> np.ndarray:  # type: ignore[type-arg]
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = pose.rotation, pose.translation
    return matrix


def quarter_turned(pose: Pose) -> Pose:
    """The camera's x axis points where its y axis pointed: down."""
    x, y, z = pose.rotation
    a, b, c = pose.translation
    return Pose(np.array([y, -x, z]), np.array([b, -a, c]))


def as_in_unity(pose: Pose) -> Pose:
    """World-to-camera with y up in both frames, which mirrors them."""
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    return from_matrix(mirror @ matrix_of(pose) @ mirror)


def with_opengl_axes(pose: Pose) -> Pose:
    return from_matrix(np.diag([1.0, -1.0, -1.0, 1.0]) @ matrix_of(pose))


def with_body_axes(pose: Pose) -> Pose:
    """Forward, left, up are the camera's z, -x, -y."""
    x, y, z = pose.rotation
    a, b, c = pose.translation
    return Pose(np.array([z, -x, -y]), np.array([c, -a, -b]))


def with_xyzw(pose: Pose) -> Pose:
    w, x, y, z = pose.rotation_wxyz
    return Pose.from_quaternion([x, y, z, w], pose.translation)


def mirrored(axis: int) -> Callable[[Pose], Pose]:
    mirror = np.eye(4)
    mirror[axis, axis] = -1.0
    return lambda pose: from_matrix(mirror @ matrix_of(pose) @ mirror)


WRITTEN: list[tuple[str, Callable[[Pose], Pose]]] = [
    ("camera-to-world poses", Pose.inverse),
    (f"world-to-camera poses {OPENGL}", with_opengl_axes),
    (f"camera-to-world poses {OPENGL}", lambda pose: with_opengl_axes(pose).inverse()),
    (
        "world-to-camera poses with axes turned by 90 degrees about the optical axis",
        quarter_turned,
    ),
    (
        "camera-to-world poses with OpenGL axes turned by 90 degrees about the optical axis",
        lambda pose: quarter_turned_of_opengl(pose).inverse(),
    ),
    ("world-to-camera poses with body axes (x forward, y left, z up)", with_body_axes),
    (
        "camera-to-world poses with body axes (x forward, y left, z up)",
        lambda pose: with_body_axes(pose).inverse(),
    ),
    ("world-to-camera poses in a left-handed frame (x mirrored)", mirrored(0)),
    ("world-to-camera poses in a left-handed frame (y mirrored, as in Unity)", as_in_unity),
    ("world-to-camera poses in a left-handed frame (z mirrored)", mirrored(2)),
    (
        "camera-to-world poses in a left-handed frame (y mirrored, as in Unity)",
        lambda pose: as_in_unity(pose).inverse(),
    ),
    (
        "poses with the camera's centre in place of the translation",
        lambda pose: Pose(pose.rotation, pose.center),
    ),
    ("poses with transposed rotations", lambda pose: Pose(pose.rotation.T, pose.translation)),
    ("poses with quaternions in the order x, y, z, w", with_xyzw),
    ("poses in centimetres", lambda pose: Pose(pose.rotation, 100.0 * pose.translation)),
    ("poses in millimetres", lambda pose: Pose(pose.rotation, 1000.0 * pose.translation)),
    ("poses in feet", lambda pose: Pose(pose.rotation, pose.translation / 0.3048)),
]


def quarter_turned_of_opengl(pose: Pose) -> Pose:
    """As ``quarter_turned``, of a camera whose y points up."""
    return quarter_turned(with_opengl_axes(pose))


@pytest.mark.parametrize(("name", "write"), WRITTEN)
def test_a_pose_written_in_a_convention_is_read_back_exactly(
    name: str, write: Callable[[Pose], Pose]
) -> None:
    for meant in poses(seed=1):
        written = write(meant)
        assert np.linalg.det(written.rotation) == pytest.approx(1.0)
        read = ALL[name](written)
        np.testing.assert_allclose(read.rotation, meant.rotation, atol=1e-12)
        np.testing.assert_allclose(read.translation, meant.translation, atol=1e-9)


def motions(some: list[Pose]) -> list[Pose]:
    return [b @ a.inverse() for a, b in itertools.pairwise(some)]


def apart(some: list[Pose], others: list[Pose]) -> float:
    return max(
        rotation_angle(a.rotation @ b.rotation.T)
        + float(np.linalg.norm(a.translation - b.translation))
        for a, b in zip(motions(some), motions(others), strict=True)
    )


@pytest.mark.parametrize("name", ALL)
def test_every_convention_reads_rigid_motion_that_no_other_reading_gives(name: str) -> None:
    written = poses(seed=2)
    meant = [ALL[name](pose) for pose in written]
    assert all(np.linalg.det(pose.rotation) == pytest.approx(1.0) for pose in meant)
    assert apart(written, meant) > 0.1
    for other, read in ALL.items():
        if other != name:
            assert apart([read(pose) for pose in written], meant) > 0.1, other
