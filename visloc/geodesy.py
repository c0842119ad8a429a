"""Positions on the Earth (WGS84) and in a local frame of metres east, north and up.

Geodetic positions are latitude (deg), longitude (deg) and height above the ellipsoid (m).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# NIMA TR8350.2, table 3.1.
_SEMI_MAJOR_M = 6378137.0
_FLATTENING = 1 / 298.257223563
_ECCENTRICITY2 = _FLATTENING * (2 - _FLATTENING)
_MEAN_RADIUS_M = 6371008.8  # of the ellipsoid, (2 a + b) / 3


def ecef_from_geodetic(positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert geodetic positions (n, 3) to metres (n, 3) from the centre of the Earth."""
    latitude, longitude = np.radians(positions[:, 0]), np.radians(positions[:, 1])
    height = positions[:, 2]
    normal = _normal(latitude)
    return np.column_stack(
        [
            (normal + height) * np.cos(latitude) * np.cos(longitude),
            (normal + height) * np.cos(latitude) * np.sin(longitude),
            (normal * (1 - _ECCENTRICITY2) + height) * np.sin(latitude),
        ]
    )


def geodetic_from_ecef(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert metres (n, 3) from the centre of the Earth to geodetic positions (n, 3).

    By fixed-point iteration on the latitude, of which each round gains two or three digits.
    """
    x, y, z = points.T
    ring = np.hypot(x, y)
    latitude = np.arctan2(z, ring * (1 - _ECCENTRICITY2))
    for _ in range(8):
        bulge = _ECCENTRICITY2 * _normal(latitude) * np.sin(latitude)
        latitude = np.arctan2(z + bulge, ring)
    # Along the normal; unlike ring / cos(latitude), it is good at the poles as well.
    height = ring * np.cos(latitude) + z * np.sin(latitude) - _SEMI_MAJOR_M**2 / _normal(latitude)
    return np.column_stack([np.degrees(latitude), np.degrees(np.arctan2(y, x)), height])


def enu_from_geodetic(
    positions: NDArray[np.float64], origin: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Convert geodetic positions (n, 3) to metres (n, 3) from a geodetic origin (3,)."""
    offsets = ecef_from_geodetic(positions) - ecef_from_geodetic(origin[None])
    return np.asarray(offsets @ enu_from_ecef(origin).T)


def geodetic_from_enu(
    points: NDArray[np.float64], origin: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Convert metres (n, 3) from a geodetic origin (3,) to geodetic positions (n, 3)."""
    return geodetic_from_ecef(points @ enu_from_ecef(origin) + ecef_from_geodetic(origin[None]))


def middle_of(positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a geodetic position (3,) amid others (n, 3), also across a pole or the 180th meridian.

    Fewer than half of them, however far away, do not move it out of the others.
    """
    middle = geodetic_from_ecef(np.median(ecef_from_geodetic(positions), axis=0)[None])[0]
    return np.array([*middle[:2], np.median(positions[:, 2])])


def ground_distance(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Metres along the ground between two geodetic positions (3,), whose heights do not count.

    The arc of a sphere over the chord of the ellipsoid: exact to a millionth within 50 km, to a
    few thousandths anywhere.
    """
    return float(ground_distances(a[None], b)[0])


def ground_distances(positions: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``ground_distance`` from each of n positions (n, 3) to b (3,): (n,) metres."""
    ground = np.array([1.0, 1.0, 0.0])
    points = ecef_from_geodetic(positions * ground) - ecef_from_geodetic((b * ground)[None])
    half = np.linalg.norm(points, axis=1) / (2 * _MEAN_RADIUS_M)
    return np.asarray(2 * _MEAN_RADIUS_M * np.arcsin(np.minimum(half, 1.0)))


def enu_from_ecef(origin: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the axes east, north and up at a geodetic origin (3,), as the rows of (3, 3)."""
    latitude, longitude = np.radians(origin[:2])
    sin_lat, cos_lat = np.sin(latitude), np.cos(latitude)
    sin_lon, cos_lon = np.sin(longitude), np.cos(longitude)
    return np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )


def _normal(latitude: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(_SEMI_MAJOR_M / np.sqrt(1 - _ECCENTRICITY2 * np.sin(latitude) ** 2))
