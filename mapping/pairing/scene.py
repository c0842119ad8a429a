"""The input and the output of a pairing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visloc.geometry import Camera, Pose


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """The photos to pair, with all data for pairings.

    Attributes:
        sensors: id of each photo's camera.
        timestamps: (n,) int64, in the dataset's unit.
        global_descriptors: (n, D) float32 unit rows by name; empty if no pairing needs them.
        tracks: (M, 2) int64 rows: 3D point, photo; the observations of a known reconstruction.
    """

    names: tuple[str, ...]
    sensors: tuple[str, ...]
    timestamps: NDArray[np.int64]
    cameras: tuple[Camera | None, ...]
    cam_from_world: tuple[Pose | None, ...]
    global_descriptors: Mapping[str, NDArray[np.float32]]
    tracks: NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Unordered pairs of photos, each once, sorted by rows.

    Attributes:
        rows: (m, 2) int64 rows of the scene, the first below the second.
        scores: (m,) float64, higher is better, comparable within one pairing only.
    """

    rows: NDArray[np.int64]
    scores: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.rows)
