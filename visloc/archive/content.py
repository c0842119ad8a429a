"""What a map holds, before it is written."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import JsonValue

from visloc.archive.gnss import Fixes
from visloc.archive.schema import Anchor, FingerprintRecord, ImageRecord, OwnTest, Vector
from visloc.geometry import Camera, Pose
from visloc.retrieval.fusion import EQUAL_GHARM, LateFusion
from visloc.retrieval.index import IndexKind

# qw qx qy qz tx ty tz
PoseRow = tuple[float, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Landmarks:
    """Landmarks and their observations.

    Attributes:
        origin: (3,) float64, origin of ``points`` in the world.
        points: (P, 3) float32.
        track_lengths: (P,) uint16.
        errors_px: (P,) float32, NaN where it does not apply.
        angles_deg: (P,) float32, NaN where it does not apply.
        offsets: (n + 1,) int64, rows of ``observed`` and ``keypoints`` by photo.
        observed: (M,) uint32 rows of ``points``.
        keypoints: (M, 2) float32 pixels.
        colors: (P, 3) uint8 RGB; None when unknown.
    """

    origin: NDArray[np.float64]
    points: NDArray[np.float32]
    track_lengths: NDArray[np.uint16]
    errors_px: NDArray[np.float32]
    angles_deg: NDArray[np.float32]
    offsets: NDArray[np.int64]
    observed: NDArray[np.uint32]
    keypoints: NDArray[np.float32]
    colors: NDArray[np.uint8] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class GlobalFeatures:
    """One global descriptor of all mapping photos.

    Attributes:
        descriptors: (n, D) unit rows; zero rows for blank photos.
        model: its float32 arrays, or as a map stores them, with large ones in int8 and their
            scales. Empty if the descriptor is ready-made.
    """

    fingerprint: FingerprintRecord
    descriptors: NDArray[np.float32]
    model: Mapping[str, NDArray[Any]]


@dataclass(frozen=True, slots=True, eq=False)
class MapContent:
    """Everything in a map except its id, version and creation time.

    Arrays may be mapped from files: none is copied whole.

    Attributes:
        rigs: cam_from_rig (7,) by rig and camera.
        image_poses: cam_from_world (n, 7).
        descriptors: yields the unit descriptors (m_i, D) float32 of each photo's observations, in
            the order of ``landmarks``. It is called twice.
        gravity: unit vector that points down in the world; None when unknown.
        computed_with: what computed the local features, for people.
        fusion: how queries rank the photos by default.
        descriptor_scale: the step in which descriptors are stored. The step of the map that they
            were read from stores them unchanged; None chooses one that fits the largest value.
        own_test: of a map that this is or is a part of; None when it took none.
        index: whether an inverted file of the global descriptors is written.
        fixes: of GNSS receivers during the captures.
    """

    metric: bool
    method: str
    settings: Mapping[str, JsonValue]
    notes: tuple[str, ...]
    cameras: Mapping[str, Camera]
    rigs: Mapping[str, Mapping[str, PoseRow]]
    images: tuple[ImageRecord, ...]
    image_poses: NDArray[np.float64]
    landmarks: Landmarks
    local_fingerprint: FingerprintRecord
    max_keypoints: int
    descriptor_dim: int
    descriptors: Callable[[], Iterator[NDArray[np.float32]]]
    global_features: tuple[GlobalFeatures, ...]
    anchor: Anchor | None = None
    gravity: Vector | None = None
    computed_with: str | None = None
    fusion: LateFusion = EQUAL_GHARM
    descriptor_scale: float | None = None
    own_test: OwnTest | None = None
    index: IndexKind = IndexKind.AUTO
    fixes: Fixes | None = None


def pose_row(pose: Pose) -> PoseRow:
    """Return a pose as it is stored: qw qx qy qz tx ty tz.

    A row that was read as a pose can come back with another last digit: pass on rows that stay.
    """
    return (*pose.rotation_wxyz.tolist(), *pose.translation.tolist())
