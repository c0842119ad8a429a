"""Which way is up in a map, and a map seen from above."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visloc.archive import Map
from visloc.geometry import Camera, Pose
from visloc.localization.map_view.constraints import Viewpoints

# A mean of directions shorter than this tells none.
_LEAST_MEAN = 0.1
# What the mean of the upper edges counts beside the rows: enough where all photos look one way.
_MEAN_WEIGHT = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """A map seen from above, and the photo that stands for all that are taken in it.

    Attributes:
        up: (3,) unit vector.
        up_source: ``gravity`` where the map knows it, else ``cameras``: from how they were held.
        right: (3,) unit vector, level.
        ahead: (3,) unit vector, level; right, ahead and up make a right-handed frame.
        pitch_deg: how far the photo looks below the level.
        quarter_turns: of the camera about its axis, clockwise as seen from behind: 1 or 3 where
            the mapping photos are stored lying on their side.
    """

    up: NDArray[np.float64]
    up_source: str
    right: NDArray[np.float64]
    ahead: NDArray[np.float64]
    pitch_deg: float
    quarter_turns: int
    camera: Camera

    @staticmethod
    def of(opened: Map, viewpoints: Viewpoints) -> Plan:
        """Stand and look as most mapping photos do."""
        up, source = _up(opened, viewpoints)
        # The world's x axis where it is level enough, so that the plan lies as the world does.
        axis = np.eye(3)[0] if abs(up[0]) < 0.9 else np.eye(3)[1]
        right = axis - (axis @ up) * up
        right /= np.linalg.norm(right)
        downwards = -(viewpoints.rotations[:, 2] @ up)
        pitch_deg = math.degrees(math.asin(float(np.clip(np.median(downwards), -1.0, 1.0))))
        # Where up is in the picture: against its y axis in most photos.
        in_picture = viewpoints.rotations[:, :2] @ up
        turns = np.rint(np.arctan2(in_picture[:, 0], -in_picture[:, 1]) / (math.pi / 2))
        quarter_turns = Counter((turns.astype(int) % 4).tolist()).most_common(1)[0][0]
        cameras = Counter(image.camera for image in opened.images)
        camera = opened.cameras[cameras.most_common(1)[0][0]]
        return Plan(up, source, right, np.cross(up, right), pitch_deg, quarter_turns, camera)

    def level(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Coordinates (n, 2) of points (n, 3) along right and ahead."""
        return np.asarray(points @ np.column_stack([self.right, self.ahead]))

    def pose(self, position: NDArray[np.float64], direction_deg: float) -> Pose:
        """``cam_from_local`` of a photo taken at a position, looking in a direction."""
        direction, pitch = math.radians(direction_deg), math.radians(self.pitch_deg)
        level = math.cos(direction) * self.right + math.sin(direction) * self.ahead
        forward = math.cos(pitch) * level - math.sin(pitch) * self.up
        x = np.cross(level, self.up)
        y = np.cross(forward, x)
        for _ in range(self.quarter_turns):
            x, y = -y, x
        rotation = np.stack([x, y, forward])
        return Pose(rotation, -rotation @ position)


def _up(opened: Map, viewpoints: Viewpoints) -> tuple[NDArray[np.float64], str]:
    """Gravity's, else as the cameras were held."""
    if opened.gravity is not None:
        return -opened.gravity, "gravity"
    up = up_of_cameras(viewpoints.rotations)
    # Photos in all orientations: any plan is as good.
    return np.array([0.0, 0.0, 1.0]) if up is None else up, "cameras"


def up_of_cameras(rotations: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """The direction (3,) to which the rows of the pictures are most nearly level.

    Whoever takes a photo holds it level, but looks up or down as they like: the mean of where the
    pictures have their upper edge leans. It decides which way round, and where all look one way.
    Of cameras that look straight down, and photos stored on their side, it is wrong.

    Args:
        rotations: (n, 3, 3) camera from world.

    Returns:
        A unit vector; None for photos in all orientations.
    """
    mean = -rotations[:, 1].mean(axis=0)
    length = float(np.linalg.norm(mean))
    if length < _LEAST_MEAN:
        return None
    mean /= length
    rows = rotations[:, 0]
    tilts = rows.T @ rows / len(rows) + _MEAN_WEIGHT * (np.eye(3) - np.outer(mean, mean))
    up = np.linalg.eigh(tilts)[1][:, 0]
    return np.asarray(up if up @ mean >= 0 else -up)
