"""From local metres to latitude and longitude (WGS 84)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# NIMA TR8350.2: semi-major axis in metres, and first eccentricity squared.
_A = 6378137.0
_E2 = 6.69437999014e-3


@dataclass(frozen=True, slots=True)
class EastNorthUp:
    """A frame that touches the ellipsoid's normal at a point: x east, y north, z up, metres.

    Attributes:
        latitude: of the origin, degrees.
        longitude: degrees.
        altitude: above the ellipsoid, metres.
    """

    latitude: float
    longitude: float
    altitude: float

    def geodetic(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return latitude and longitude in degrees and altitude in metres (N, 3) of points (N, 3).

        Exact to well below a millimetre from the ground to the height of satellites.
        """
        lat, lon = np.radians([self.latitude, self.longitude])
        east = [-np.sin(lon), np.cos(lon), 0.0]
        up = [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]
        north = np.cross(up, east)
        ecef = points @ np.array([east, north, up]) + self._origin(lat, lon)
        return _geodetic_from_ecef(ecef)

    def _origin(self, lat: float, lon: float) -> NDArray[np.float64]:
        normal = _A / np.sqrt(1 - _E2 * np.sin(lat) ** 2)
        ring = (normal + self.altitude) * np.cos(lat)
        polar = (normal * (1 - _E2) + self.altitude) * np.sin(lat)
        return np.array([ring * np.cos(lon), ring * np.sin(lon), polar])


def _geodetic_from_ecef(ecef: NDArray[np.float64]) -> NDArray[np.float64]:
    """Invert by fixed-point iteration on the latitude; each round gains two or three digits."""
    x, y, z = ecef.T
    ring = np.hypot(x, y)
    lat = np.arctan2(z, ring * (1 - _E2))
    for _ in range(8):
        normal = _A / np.sqrt(1 - _E2 * np.sin(lat) ** 2)
        lat = np.arctan2(z + _E2 * normal * np.sin(lat), ring)
    # Along the normal; unlike ring / cos(lat), it is good at the poles as well.
    normal = _A / np.sqrt(1 - _E2 * np.sin(lat) ** 2)
    altitude = ring * np.cos(lat) + z * np.sin(lat) - _A**2 / normal
    return np.column_stack([np.degrees(lat), np.degrees(np.arctan2(y, x)), altitude])
