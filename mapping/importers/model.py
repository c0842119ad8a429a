"""The common model that every importer makes of another tool's reconstruction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapping.importers.left_out import LeftOut
from mapping.stages.depth import DEFAULT_DEPTH_SCALE
from visloc.geometry import Pose
from visloc.kapture import GnssRecord, Sensor


@dataclass(frozen=True, slots=True, eq=False)
class ImportedImage:
    """One photo of a foreign reconstruction.

    Attributes:
        name: path relative to the folder of photos, with forward slashes.
        timestamp: unique per camera; the photo's rank where the format has none.
        cam_from_world: pose; None when it was not reconstructed.
        keypoints: (n, 2 or more) float32 x, y, ... in pixels, top-left centre at (0.5, 0.5); None
            when the format has none.
        descriptors: (n, D), row by row those of the keypoints; None without.
        depth: its depth map, relative to the folder of photos; None without.
        mask: its mask, black where the photo does not count, relative to the same; None without.
    """

    name: str
    sensor: str
    timestamp: int
    cam_from_world: Pose | None
    keypoints: NDArray[np.float32] | None = None
    descriptors: NDArray[Any] | None = None
    depth: str | None = None
    mask: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ImportedModel:
    """A foreign reconstruction in our conventions.

    Attributes:
        sensors: cameras by id, and the GNSS receiver or depth sensors if there are any. A camera
            whose intrinsics are unknown is an UNKNOWN_CAMERA (``Sensor.camera`` is None).
        photos: folder that their names are relative to; None when the model comes without photos.
        points: (P, 3) float64 in the world; P = 0 without points.
        colors: (P, 3) uint8.
        observations: (M, 3) int64 rows: point, image, row of that image's keypoints.
        keypoints_type: folder name for the keypoints, such as ``sift``.
        metric: whether a unit of the world is known to be a metre.
        depth_scale: units of the world in one unit of the depth maps.
        notes: what was left out or assumed, one sentence each.
        left_out: names of files in the folder of photos that are not used, by reason.
    """

    sensors: Mapping[str, Sensor]
    images: tuple[ImportedImage, ...]
    photos: Path | None
    points: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)))
    colors: NDArray[np.uint8] = field(default_factory=lambda: np.empty((0, 3), np.uint8))
    observations: NDArray[np.int64] = field(default_factory=lambda: np.empty((0, 3), np.int64))
    keypoints_type: str = "imported"
    gnss: tuple[GnssRecord, ...] = ()
    metric: bool = False
    depth_scale: float = DEFAULT_DEPTH_SCALE
    notes: tuple[str, ...] = ()
    left_out: LeftOut = field(default_factory=dict)
