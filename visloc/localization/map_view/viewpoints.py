"""Where the mapping photos stood, and how far apart two viewpoints are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visloc.geometry import Pose
from visloc.pose.distance import viewpoints_apart


@dataclass(frozen=True, slots=True, eq=False)
class Viewpoints:
    """The mapping photos' poses, relative to the map's origin.

    Attributes:
        centers: (n, 3) float64.
        rotations: (n, 3, 3) float64, camera from world.
        reach: median distance from photos to what they see, units of the world; above 0.
    """

    centers: NDArray[np.float64]
    rotations: NDArray[np.float64]
    reach: float

    def __len__(self) -> int:
        return len(self.centers)

    def of(self, images: NDArray[np.int64]) -> Viewpoints:
        """Return the viewpoints of some photos."""
        return Viewpoints(self.centers[images], self.rotations[images], self.reach)

    def pose(self, image: int) -> Pose:
        """``cam_from_local`` of one photo."""
        rotation = self.rotations[image]
        return Pose(rotation, -rotation @ self.centers[image])

    def apart_from(self, pose: Pose) -> NDArray[np.float64]:
        """Return the distance (n,) of each photo from a pose, in radians (``viewpoints_apart``)."""
        return viewpoints_apart(self.rotations, self.centers, pose, self.reach)
