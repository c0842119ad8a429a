"""Which frames of a film show something new."""

from __future__ import annotations

import numpy as np

from visloc.geometry import Pose, rotation_angle

# A frame counts when the camera has moved so far since the last one.
_STEP_M, _TURN_RAD = 0.25, np.radians(10.0)


def has_moved(before: Pose, after: Pose) -> bool:
    """Tell whether two ``cam_from_world`` in a world in metres are far enough apart."""
    moved = float(np.linalg.norm(before.center - after.center))
    return moved >= _STEP_M or rotation_angle(before.rotation @ after.rotation.T) >= _TURN_RAD
