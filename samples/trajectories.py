"""Where the sample rig stands and looks, and the rig itself.

Rig axes are those of a camera that looks straight ahead: x right, y down, z forward.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from visloc.geometry import Camera, Pose

_BASELINE_M = 0.2
# A full run is one turn of the path and two of the gaze, so that every wall is seen from near
# and from across the room. A short run does only a part of it, for neighbours to overlap.
_FULL_RUN_GAZE_DEG = 720.0
_MOST_TURN_DEG = 24.0
_PATH_M = (1.25, 0.8)  # half axes of the ellipse that the rig follows
_HEIGHT_M = 1.45


@dataclass(frozen=True, slots=True)
class RigCamera:
    """A camera of the rig."""

    camera: Camera
    cam_from_rig: Pose


def stereo_rig(width: int, height: int) -> Mapping[str, RigCamera]:
    """Return the cameras ``left`` and ``right``, 0.2 m apart, about 70 degrees wide.

    They differ a little in focal length, principal point and direction, as real ones do, so that
    mixing them up shows.
    """
    focal = round(0.715 * max(width, height), 1)
    left = Camera("PINHOLE", width, height, (focal, focal, 0.503 * width, 0.496 * height))
    right = Camera("PINHOLE", width, height, (focal + 3, focal + 3, 0.497 * width, 0.505 * height))
    return {
        "left": RigCamera(left, _mounted(-_BASELINE_M / 2, yaw_deg=-2.5, pitch_deg=0.4)),
        "right": RigCamera(right, _mounted(_BASELINE_M / 2, yaw_deg=2.0, pitch_deg=-0.7)),
    }


def mapping_trajectory(num_instants: int) -> list[Pose]:
    """Return ``rig_from_world`` of the mapping run: a loop through the room."""
    progress = _run_length(num_instants) * (np.arange(num_instants) + 0.5) / num_instants
    return [_loop(share) for share in progress.tolist()]


def query_trajectory(num_instants: int, num_mapping_instants: int) -> list[Pose]:
    """Return ``rig_from_world`` of a later walk along the same stretch, but on no mapped pose.

    It keeps 10 to 25 cm to the inside of the mapping run, and looks up to 10 degrees elsewhere.
    """
    length = _run_length(num_mapping_instants)
    progress = length * (np.arange(num_instants) + 0.5) / num_instants
    return [_stroll(share) for share in progress.tolist()]


def _run_length(num_instants: int) -> float:
    """Return the share of the full run that so many instants can cover with overlap."""
    return min(1.0, num_instants * _MOST_TURN_DEG / _FULL_RUN_GAZE_DEG)


def _loop(share: float) -> Pose:
    angle = 2 * np.pi * share
    position = (
        _PATH_M[0] * np.cos(angle),
        _PATH_M[1] * np.sin(angle),
        _HEIGHT_M + 0.2 * np.sin(3 * angle),
    )
    return _looking(
        position,
        yaw_deg=_FULL_RUN_GAZE_DEG * share + 20 * np.sin(angle),
        pitch_deg=-9 + 9 * np.sin(5 * angle + 0.5),
        roll_deg=3 * np.sin(4 * angle),
    )


def _stroll(share: float) -> Pose:
    angle = 2 * np.pi * share
    scale = 0.82 + 0.06 * np.sin(6 * angle)
    position = (
        scale * _PATH_M[0] * np.cos(angle + 0.06),
        scale * _PATH_M[1] * np.sin(angle + 0.06),
        _HEIGHT_M + 0.2 * np.sin(3 * angle) - 0.07 + 0.08 * np.cos(5 * angle),
    )
    return _looking(
        position,
        yaw_deg=_FULL_RUN_GAZE_DEG * share + 20 * np.sin(angle) + 10 * np.sin(4 * angle + 1),
        pitch_deg=-8 + 7 * np.sin(5 * angle + 1.1),
        roll_deg=4 * np.sin(3 * angle + 2),
    )


def _looking(
    position: tuple[float, float, float], *, yaw_deg: float, pitch_deg: float, roll_deg: float
) -> Pose:
    """Return ``rig_from_world``: yaw from the world's x to y, pitch upwards, roll clockwise."""
    yaw, pitch, roll = np.deg2rad([yaw_deg, pitch_deg, roll_deg])
    forward = np.array([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    down = np.cross(forward, right)
    rotation = np.array(
        [
            np.cos(roll) * right + np.sin(roll) * down,
            np.cos(roll) * down - np.sin(roll) * right,
            forward,
        ]
    )
    return Pose(rotation, -rotation @ np.array(position))


def _mounted(right_m: float, *, yaw_deg: float, pitch_deg: float) -> Pose:
    """Return ``cam_from_rig`` of a camera beside the rig's origin, turned right and up."""
    yaw, pitch = np.deg2rad([yaw_deg, pitch_deg])
    turn_right = np.array(
        [[np.cos(yaw), 0, -np.sin(yaw)], [0, 1, 0], [np.sin(yaw), 0, np.cos(yaw)]]
    )
    turn_up = np.array(
        [[1, 0, 0], [0, np.cos(pitch), np.sin(pitch)], [0, -np.sin(pitch), np.cos(pitch)]]
    )
    rotation = turn_up @ turn_right
    return Pose(rotation, -rotation @ np.array([right_m, 0.0, 0.0]))
