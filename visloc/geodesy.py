"""Positions on the Earth and in a local frame of metres. WGS84."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# NIMA TR8350.2, table 3.1.
_SEMI_MAJOR_M = 6378137.0
_FLATTENING = 1 / 298.257223563
_ECCENTRICITY2 = _FLATTENING * (2 - _FLATTENING)


def ecef_from_geodetic(positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert latitude (deg), longitude (deg), ellipsoidal height (m), (n, 3), to metres (n, 3)."""
    latitude, longitude = np.radians(positions[:, 0]), np.radians(positions[:, 1])
    height = positions[:, 2]
    normal = _SEMI_MAJOR_M / np.sqrt(1 - _ECCENTRICITY2 * np.sin(latitude) ** 2)
    return np.column_stack(
        [
            (normal + height) * np.cos(latitude) * np.cos(longitude),
            (normal + height) * np.cos(latitude) * np.sin(longitude),
            (normal * (1 - _ECCENTRICITY2) + height) * np.sin(latitude),
        ]
    )


def enu_from_geodetic(
    positions: NDArray[np.float64], origin: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Convert positions (n, 3) to metres east, north and up (n, 3) of an origin (3,).

    Both are latitude (deg), longitude (deg), ellipsoidal height (m).
    """
    latitude, longitude = np.radians(origin[:2])
    sin_lat, cos_lat = np.sin(latitude), np.cos(latitude)
    sin_lon, cos_lon = np.sin(longitude), np.cos(longitude)
    enu_from_ecef = np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )
    offsets = ecef_from_geodetic(positions) - ecef_from_geodetic(origin[None])
    return np.asarray(offsets @ enu_from_ecef.T)
