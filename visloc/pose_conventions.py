"""Conventions in which others write poses, and the pose that each of them means.

Given poses that contradict what photos show, the reading that makes them agree names the mistake.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
from numpy.typing import NDArray

from visloc.geometry import Pose

Reading = Callable[[Pose], Pose]

# Our camera axes (x right, y down, z forward) from those of others.
_QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_OPENGL = np.diag([1.0, -1.0, -1.0])
_AXES: Mapping[str, NDArray[np.float64]] = {
    "": np.eye(3),
    "with OpenGL axes (x right, y up, z backward)": _OPENGL,
    "with body axes (x forward, y left, z up)": np.array(
        [[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]
    ),
    **{
        f"{of} turned by {90 * turns} degrees about the optical axis": axes
        @ np.linalg.matrix_power(_QUARTER, turns)
        for of, axes in (("with axes", np.eye(3)), ("with OpenGL axes", _OPENGL))
        for turns in (1, 2, 3)
    },
    "in a left-handed frame (x mirrored)": np.diag([-1.0, 1.0, 1.0]),
    "in a left-handed frame (y mirrored, as in Unity)": np.diag([1.0, -1.0, 1.0]),
    "in a left-handed frame (z mirrored)": np.diag([1.0, 1.0, -1.0]),
}


def _with_axes(axes: NDArray[np.float64], inverted: bool, written: Pose) -> Pose:
    pose = written.inverse() if inverted else written
    # Axes that mirror the camera's frame mirror the world's, too, or no rotation would be left.
    world = axes if np.linalg.det(axes) < 0 else np.eye(3)
    return Pose(axes @ pose.rotation @ world, axes @ pose.translation)


def _with_centre(written: Pose) -> Pose:
    return Pose(written.rotation, -written.rotation @ written.translation)


def _with_transposed_rotation(written: Pose) -> Pose:
    return Pose(written.rotation.T, written.translation)


def _with_last_first(written: Pose) -> Pose:
    return Pose.from_quaternion(np.roll(written.rotation_wxyz, 1), written.translation)


def _with_unit(metres: float, written: Pose) -> Pose:
    return Pose(written.rotation, metres * written.translation)


# By a phrase for "They look like ...": the cam_from_world that a pose means if it was written so,
# but read as cam_from_world. Of mirrored frames, the world is mirrored back along the same axis.
READINGS: Mapping[str, Reading] = {
    **{
        f"{kind} poses {axes}".rstrip(): partial(_with_axes, matrix, inverted)
        for inverted, kind in ((True, "camera-to-world"), (False, "world-to-camera"))
        for axes, matrix in _AXES.items()
        if inverted or axes
    },
    "poses with the camera's centre in place of the translation": _with_centre,
    "poses with transposed rotations": _with_transposed_rotation,
    "poses with quaternions in the order x, y, z, w": _with_last_first,
}
# The same for lengths in another unit than the metre.
UNIT_READINGS: Mapping[str, Reading] = {
    f"poses in {unit}": partial(_with_unit, metres)
    for unit, metres in (("centimetres", 0.01), ("millimetres", 0.001), ("feet", 0.3048))
}
