"""Printed markers of known size: ArUco and AprilTag, found in the photos, measured in the map."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from mapping.progress import ItemProgress
from mapping.stages.landmarks import View
from mapping.stages.photos import MappingPhoto
from visloc.pose.reprojection import normalized_rays, project

# Each holds its smaller sisters. AprilTag 16h5 is left out: every tenth window frame is one.
_DICTIONARIES = (
    *("DICT_4X4_1000", "DICT_5X5_1000", "DICT_6X6_1000", "DICT_7X7_1000", "DICT_ARUCO_ORIGINAL"),
    *("DICT_APRILTAG_25h9", "DICT_APRILTAG_36h11"),
)
# A sighting that fits a marker's corners, of the longer side of the photo: 3 px of 1000.
_MAX_ERROR = 0.003
# Sides of a square, and its diagonals, agree to this share.
_SQUARE = 0.05
# Rays that meet at less than this say too little of how far away a corner is.
_LEAST_ANGLE_DEG = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """A marker in a photo.

    Attributes:
        corners: (4, 2) float64 pixels as stored, in order around the marker.
    """

    photo: str
    marker: tuple[str, int]
    corners: NDArray[np.float64]


def find_markers(
    photos: Iterable[tuple[str, NDArray[np.uint8]]], total: int, progress: ItemProgress
) -> list[Sighting]:
    """Find all markers in grey photos (H, W) by name."""
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detectors = {
        name: cv2.aruco.ArucoDetector(
            cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)), settings
        )
        for name in _DICTIONARIES
    }
    found = []
    progress(0, total)
    for done, (photo, grey) in enumerate(photos, 1):
        for name, detector in detectors.items():
            # Typed as never None; it is None where there is no marker.
            corners, numbers, _ = detector.detectMarkers(grey)
            ids = [] if numbers is None else np.ravel(numbers).astype(int).tolist()
            for quad, number in zip(corners, ids, strict=True):
                # OpenCV counts from the centre of the first pixel.
                pixels = np.asarray(quad, np.float64).reshape(4, 2) + 0.5
                found.append(Sighting(photo, (name, number), pixels))
        progress(done, total)
    return _seen_again(found)


def _seen_again(sightings: Sequence[Sighting]) -> list[Sighting]:
    """Keep markers that two photos show, once each: of two prints of one, neither is known."""
    kept: dict[tuple[str, int], list[Sighting]] = {}
    for sighting in sightings:
        kept.setdefault(sighting.marker, []).append(sighting)
    return [
        sighting
        for group in kept.values()
        if len({one.photo for one in group}) == len(group) >= 2
        for sighting in group
    ]


def marker_sides(
    sightings: Sequence[Sighting], views: Mapping[str, View]
) -> dict[tuple[str, int], float]:
    """Return the side of each marker in units of the map.

    A marker's corners are triangulated from all photos of it; those that do not fit, or make no
    square, are left out.

    Args:
        views: of the map's photos, by name.
    """
    groups: dict[tuple[str, int], list[Sighting]] = {}
    for sighting in sightings:
        if sighting.photo in views:
            groups.setdefault(sighting.marker, []).append(sighting)
    sides = {}
    for marker, group in groups.items():
        corners = _corners(group, [views[one.photo] for one in group])
        if corners is not None and (side := _side_of_square(corners)) is not None:
            sides[marker] = side
    return sides


def _corners(sightings: Sequence[Sighting], views: Sequence[View]) -> NDArray[np.float64] | None:
    """The corners (4, 3) in the world that most sightings agree on; None without any."""
    best: NDArray[np.bool_] | None = None
    for pair in combinations(range(min(len(views), 12)), 2):
        points = _triangulated([sightings[i] for i in pair], [views[i] for i in pair])
        if points is None:
            continue
        fits = np.array([_fits(points, s, v) for s, v in zip(sightings, views, strict=True)])
        if fits[list(pair)].all() and (best is None or fits.sum() > best.sum()):
            best = fits
    if best is None:
        return None
    agreeing = np.flatnonzero(best).tolist()
    return _triangulated([sightings[i] for i in agreeing], [views[i] for i in agreeing])


def _fits(points: NDArray[np.float64], sighting: Sighting, view: View) -> bool:
    errors = np.linalg.norm(
        project(view.camera, view.cam_from_world.apply(points)) - sighting.corners, axis=1
    )
    limit = _MAX_ERROR * max(view.camera.width, view.camera.height)
    return bool((errors <= limit).all())  # False for NaN


def _triangulated(
    sightings: Sequence[Sighting], views: Sequence[View]
) -> NDArray[np.float64] | None:
    """The points (4, 3) nearest to the rays of the corners; None if these are nearly parallel."""
    centers = np.array([view.cam_from_world.center for view in views])
    rays = np.array(
        [
            normalized_rays(view.camera, sighting.corners) @ view.cam_from_world.rotation
            for sighting, view in zip(sightings, views, strict=True)
        ]
    )
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    points = np.empty((4, 3))
    for corner in range(4):
        own = rays[:, corner]
        if not np.isfinite(own).all() or (own @ own.T).min() > np.cos(np.radians(_LEAST_ANGLE_DEG)):
            return None
        # The sum of squared distances to the rays is least where sum (I - r r^T)(x - c) = 0.
        across = np.eye(3) - own[:, :, None] * own[:, None, :]
        right = (across @ centers[:, :, None]).sum(axis=0)[:, 0]
        points[corner] = np.linalg.solve(across.sum(axis=0), right)
    return points


def _side_of_square(corners: NDArray[np.float64]) -> float | None:
    sides = np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1)
    diagonals = np.linalg.norm(corners[:2] - corners[2:], axis=1) / np.sqrt(2)
    lengths = np.concatenate([sides, diagonals])
    side = float(lengths.mean())
    return side if np.abs(lengths - side).max() <= _SQUARE * side else None


def grey_photos(photos: Sequence[MappingPhoto]) -> Iterable[tuple[str, NDArray[np.uint8]]]:
    """Decode photos one after the other, in the frame of their cameras."""
    for photo in photos:
        yield photo.name, np.asarray(cv2.cvtColor(photo.read().rgb, cv2.COLOR_RGB2GRAY), np.uint8)
