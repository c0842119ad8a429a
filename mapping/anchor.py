"""Where a reconstruction lies in the world: aligned to known poses, positions or GNSS fixes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import PIL.Image  # noqa: F401  before pycolmap, see visloc.pose.colmap
import pycolmap
from numpy.typing import NDArray

from mapping.photos import MappingPhoto
from visloc.archive import Anchor, Geodetic
from visloc.geodesy import enu_from_geodetic
from visloc.geometry import Pose
from visloc.kapture import Dataset

# A fix of a phone or a consumer receiver is seldom further off.
GNSS_ERROR_M = 10.0
# Known positions further off than this part of their spread are mistakes.
_POSITION_ERROR = 0.05
# Three positions give a similarity whatever they are; the fourth can object.
_MIN_POSITIONS = 3
_EPSG_WGS84 = "EPSG:4326"


@dataclass(frozen=True, slots=True, eq=False)
class Similarity:
    """x_b = scale R x_a + t."""

    scale: float
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]

    def apply(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Map points (n, 3)."""
        return np.asarray(self.scale * points @ self.rotation.T + self.translation)

    def move(self, cam_from_world: Pose) -> Pose:
        """Return the pose of a camera after its world was mapped."""
        center = self.apply(cam_from_world.center[None])[0]
        rotation = cam_from_world.rotation @ self.rotation.T
        return Pose(rotation, -rotation @ center)


@dataclass(frozen=True, slots=True, eq=False)
class KnownPositions:
    """What is known of where the photos were taken, before they are reconstructed.

    Attributes:
        anchor: what kind of knowledge; its ``rms`` is not known yet.
        photos: (n,) rows of the photos.
        positions: (n, 3) in the world that the map is to have.
        max_error: RANSAC's threshold, in the unit of the positions.
    """

    anchor: Anchor
    photos: NDArray[np.int64]
    positions: NDArray[np.float64]
    max_error: float


def known_positions(dataset: Dataset, photos: Sequence[MappingPhoto]) -> KnownPositions | None:
    """Find the poses of at least three photos, else the GNSS fixes at their timestamps.

    GNSS fixes become metres east, north and up of their mean; those of a receiver with a projected
    coordinate system are metres already.
    """
    posed = [row for row, photo in enumerate(photos) if photo.cam_from_world is not None]
    if len(posed) >= _MIN_POSITIONS:
        positions = np.array([photos[row].pose.center for row in posed])
        spread = float(np.linalg.norm(positions - np.median(positions, axis=0), axis=1).max())
        anchor = Anchor(kind="positions", images=len(posed))
        return KnownPositions(anchor, np.array(posed), positions, _POSITION_ERROR * spread)
    fixes = {fix.timestamp: fix for fix in dataset.gnss}
    rows = [row for row, photo in enumerate(photos) if photo.record.timestamp in fixes]
    if len(rows) < _MIN_POSITIONS:
        return None
    chosen = [fixes[photos[row].record.timestamp] for row in rows]
    xyz = np.array([[fix.x, fix.y, fix.z] for fix in chosen])
    systems = {(dataset.sensors[fix.sensor_id].params or (_EPSG_WGS84,))[0] for fix in chosen}
    if systems != {_EPSG_WGS84}:
        return KnownPositions(
            Anchor(kind="gnss", images=len(rows)), np.array(rows), xyz, GNSS_ERROR_M
        )
    geodetic = xyz[:, [1, 0, 2]]
    origin = geodetic.mean(axis=0)
    anchor = Anchor(
        kind="gnss",
        images=len(rows),
        geodetic=Geodetic(latitude_deg=origin[0], longitude_deg=origin[1], altitude_m=origin[2]),
    )
    return KnownPositions(anchor, np.array(rows), enu_from_geodetic(geodetic, origin), GNSS_ERROR_M)


def align_positions(
    centers: NDArray[np.float64], known: NDArray[np.float64], max_error: float
) -> tuple[Similarity, NDArray[np.bool_]] | None:
    """Find the similarity that maps camera centres (n, 3) to known positions (n, 3), robustly.

    Returns:
        The similarity and which positions agree with it; None when fewer than three do, or when
        they lie in a line, about which the world could turn.
    """
    if len(centers) < _MIN_POSITIONS:
        return None
    spread = np.linalg.svd(known - known.mean(axis=0), compute_uv=False)
    if spread[1] <= 1e-3 * spread[0]:
        return None
    options = pycolmap.RANSACOptions(max_error=max(max_error, 1e-9), random_seed=0)
    # Its stub promises a Sim3d; what comes is a dict.
    found = cast("dict[str, Any] | None", pycolmap.estimate_sim3d_robust(centers, known, options))
    if found is None or int(found["num_inliers"]) < _MIN_POSITIONS:
        return None
    sim = found["tgt_from_src"]
    similarity = Similarity(
        float(sim.scale), np.array(sim.rotation.matrix()), np.array(sim.translation)
    )
    return similarity, np.array(found["inlier_mask"], dtype=np.bool_)


def align_poses(moved: Sequence[Pose], given: Sequence[Pose]) -> Similarity:
    """Find the similarity that brings poses back to where they were given, in the mean.

    The rotation comes from the orientations, so that positions in a line do no harm.
    """
    nearest = np.sum([b.rotation.T @ a.rotation for a, b in zip(moved, given, strict=True)], axis=0)
    u, _, vt = np.linalg.svd(nearest)
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    source = np.array([pose.center for pose in moved]) @ rotation.T
    target = np.array([pose.center for pose in given])
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    variance = float(np.sum((source - source_mean) ** 2))
    shared = float(np.sum((source - source_mean) * (target - target_mean)))
    scale = shared / variance if variance > 0 and shared > 0 else 1.0
    return Similarity(scale, rotation, target_mean - scale * source_mean)
