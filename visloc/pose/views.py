"""The views of a rig's cameras: their matches with a map."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from visloc.geometry import CAMERA_MODELS, Camera, Pose


@dataclass(frozen=True, slots=True, eq=False)
class MatchedView:
    """One camera of a rig and its 2D-3D correspondences; there may be none.

    Attributes:
        camera: intrinsics.
        cam_from_rig: where it sits; the identity for a camera on its own.
        pixels: (n, 2) float64 in the camera's image; those matched best come first, where that is
            known.
        points: (n, 3) float64 in a world frame whose numbers are not large.
        focal_unknown: the camera's focal length is a guess to be found together with the pose, or
            was found so.
    """

    camera: Camera
    cam_from_rig: Pose
    pixels: NDArray[np.float64]
    points: NDArray[np.float64]
    focal_unknown: bool = False

    def __len__(self) -> int:
        return len(self.pixels)

    def selected(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> MatchedView:
        """Keep some of the correspondences, by mask or by rows."""
        return replace(self, pixels=self.pixels[which], points=self.points[which])

    @property
    def principal_point(self) -> NDArray[np.float64]:
        """Where the camera looks, (2,) in pixels."""
        params = dict(zip(CAMERA_MODELS[self.camera.model], self.camera.params, strict=True))
        return np.array([params["cx"], params["cy"]])

    def zoomed(self, factor: float) -> MatchedView:
        """Take the correspondences for those of a camera with so many times the focal length."""
        camera = self.camera
        params = tuple(
            value * factor if name in ("f", "fx", "fy") else value
            for name, value in zip(CAMERA_MODELS[camera.model], camera.params, strict=True)
        )
        return replace(self, camera=replace(camera, params=params))
