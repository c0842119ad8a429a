"""What the cameras of a rig see of a map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visloc.geometry import Camera, Pose


@dataclass(frozen=True, slots=True, eq=False)
class MatchedView:
    """One camera of a rig and its 2D-3D correspondences; there may be none.

    Attributes:
        camera: intrinsics.
        cam_from_rig: where it sits; the identity for a camera on its own.
        pixels: (n, 2) float64 in the camera's image; those matched best come first, where that is
            known.
        points: (n, 3) float64 in a world frame whose numbers are not large.
    """

    camera: Camera
    cam_from_rig: Pose
    pixels: NDArray[np.float64]
    points: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.pixels)

    def selected(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> MatchedView:
        """Keep some of the correspondences, by mask or by rows."""
        return MatchedView(self.camera, self.cam_from_rig, self.pixels[which], self.points[which])
