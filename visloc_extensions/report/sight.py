"""Predict which landmarks a photo taken somewhere would see, and from which mapping photos."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visloc.geometry import Camera, Pose
from visloc.localization.map_view.constraints import Viewpoints
from visloc.options import LocalizeOptions
from visloc.pose.reprojection import normalized_rays, project
from visloc_extensions.report.places import Places

# As many as a query is matched with. Those nearest in pose stand for those most alike.
_NUM_PHOTOS = LocalizeOptions().top_k
# Of the photos that see a place, that counts which differs least: an angle as large, or twice the
# distance, are told apart from the query as badly.
_ANGLE_DEG_OF_OCTAVE = 30.0
# Where something stands in front is told by tiles of the picture, so many along the longer side.
_TILES = 16
_NEAR_SHARE = 0.1  # part of a tile's places that are in front
_LEAST_DISTANCE = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """Places in view, and how the photo that knows each best differs from the pose.

    Attributes:
        apart: radians to the nearest photo, as ``Viewpoints.apart_from``; infinity without any.
        places: (k,) int64 rows.
        pixels: (k, 2) float64.
        rays: (k, 3) float64 unit vectors in the camera's frame.
        distances: (k,) float64 from the camera, above 0.
        angles_deg: (k,) float64 between the directions from which the photo and the pose see it.
        octaves: (k,) float64 binary logarithm of the pose's distance by the photo's.
        observers: (k,) int64, how often photos near the pose see it, 1 or more.
        behind: (k,) float64 binary logarithm of its depth by that of what stands in front in the
            same part of the picture; mostly 0 or more.
    """

    apart: float
    places: NDArray[np.int64]
    pixels: NDArray[np.float64]
    rays: NDArray[np.float64]
    distances: NDArray[np.float64]
    angles_deg: NDArray[np.float64]
    octaves: NDArray[np.float64]
    observers: NDArray[np.int64]
    behind: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.places)


@dataclass(frozen=True, slots=True, eq=False)
class Absent:
    """The part of a map to leave out.

    Attributes:
        photos: (k,) int64 rows.
        landmarks: int64, those that are gone with them, of the places' landmarks at least.
    """

    photos: NDArray[np.int64]
    landmarks: NDArray[np.int64]


def look_around(
    places: Places,
    viewpoints: Viewpoints,
    pose: Pose,
    camera: Camera,
    absent: Absent | None = None,
) -> Sight:
    """Find what is in view at a pose, as the photos near it know it.

    Args:
        pose: ``cam_from_local``, relative to the map's origin.
        absent: what is not in the map.
    """
    apart = viewpoints.apart_from(pose)
    if absent is not None:
        apart[absent.photos] = np.inf
    near = np.argsort(apart, kind="stable")[:_NUM_PHOTOS]
    rows, photos = places.rows(near[np.isfinite(apart[near])])
    if absent is not None:
        there = ~np.isin(places.landmarks[rows], absent.landmarks)
        rows, photos = rows[there], photos[there]
    found, which = np.unique(places.seen[rows], return_inverse=True)
    in_cam = pose.apply(places.points[found])
    pixels = project(camera, in_cam)
    inside = _in_picture(camera, pixels, in_cam)
    shown = inside[which]
    which, photos = which[shown], photos[shown]

    points = places.points[found[which]]
    from_pose, from_photo = points - pose.center, points - viewpoints.centers[photos]
    distance, photo_distance = (
        np.maximum(np.linalg.norm(rays, axis=1), _LEAST_DISTANCE)
        for rays in (from_pose, from_photo)
    )
    cosines = np.sum(from_pose * from_photo, axis=1) / (distance * photo_distance)
    angles_deg = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
    octaves = np.log2(distance / photo_distance)
    order = np.lexsort((angles_deg / _ANGLE_DEG_OF_OCTAVE + np.abs(octaves), which))
    seen, first, counts = np.unique(which[order], return_index=True, return_counts=True)
    best = order[first]
    return Sight(
        float(apart[near[0]]),
        found[seen],
        pixels[seen],
        in_cam[seen] / distance[best][:, None],
        distance[best],
        angles_deg[best],
        octaves[best],
        counts,
        _behind(camera, pixels[seen], in_cam[seen, 2]),
    )


def _in_picture(
    camera: Camera, pixels: NDArray[np.float64], in_cam: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Which points (n,) fall into the picture."""
    with np.errstate(invalid="ignore"):  # NaN behind the camera is not inside
        inside = (pixels >= 0).all(axis=1) & (pixels < (camera.width, camera.height)).all(axis=1)
    # Far beyond the border, polynomials of lens distortion turn back into the picture.
    w, h = camera.width, camera.height
    border = np.array(
        [(0, 0), (w, 0), (0, h), (w, h), (w / 2, 0), (w / 2, h), (0, h / 2), (w, h / 2)]
    )
    rays = normalized_rays(camera, border.astype(np.float64))
    widest = np.max(np.hypot(rays[:, 0], rays[:, 1]))
    if np.isfinite(widest):
        sideways = np.hypot(in_cam[:, 0], in_cam[:, 1])
        inside &= sideways <= 1.05 * widest * np.maximum(in_cam[:, 2], 0.0)
    return np.asarray(inside & (in_cam[:, 2] > 0))


def _behind(
    camera: Camera, pixels: NDArray[np.float64], depths: NDArray[np.float64]
) -> NDArray[np.float64]:
    """How much deeper points (n,) are than what stands in front in the same tile, in octaves."""
    if len(depths) == 0:
        return np.empty(0)
    tiles = (pixels * (_TILES / max(camera.width, camera.height))).astype(np.int64)
    tile = tiles[:, 1] * _TILES + tiles[:, 0]
    order = np.lexsort((depths, tile))
    _, first, counts = np.unique(tile[order], return_index=True, return_counts=True)
    front = depths[order][first + (counts * _NEAR_SHARE).astype(np.int64)]
    fronts = np.empty(len(depths))
    fronts[order] = np.repeat(front, counts)
    return np.asarray(np.log2(depths / fronts))
