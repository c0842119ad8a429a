"""Where a map lies on Earth, from its manifest alone."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visloc.archive.schema import Geodetic, World
from visloc.archive.set_schema import SetWorld
from visloc.geodesy import enu_from_geodetic, geodetic_from_enu, ground_distance
from visloc.geometry import Pose


@dataclass(frozen=True, slots=True)
class GeoCircle:
    """A circle on Earth, WGS84.

    Attributes:
        latitude: degrees.
        longitude: degrees.
        radius: metres.
    """

    latitude: float
    longitude: float
    radius: float

    def distance_to(self, latitude: float, longitude: float) -> float:
        """Metres from the circle to a position (deg); 0 within it."""
        middle = np.array([self.latitude, self.longitude, 0.0])
        return max(0.0, ground_distance(middle, np.array([latitude, longitude, 0.0])) - self.radius)


def enu_of(points: NDArray[np.float64], geodetic: Geodetic) -> NDArray[np.float64]:
    """Convert points (n, 3) of a world to metres (n, 3) east, north and up of its anchor."""
    enu_from_world = Pose.from_quaternion(geodetic.rotation_wxyz, geodetic.translation)
    return enu_from_world.apply(geodetic.scale * points)


def origin_of(geodetic: Geodetic) -> NDArray[np.float64]:
    """Return the anchor's geodetic position (3,), as ``visloc.geodesy`` has them."""
    return np.array([geodetic.latitude_deg, geodetic.longitude_deg, geodetic.altitude_m])


def down_of(geodetic: Geodetic) -> NDArray[np.float64]:
    """Return the unit vector (3,) that points down in a world."""
    rotation = Pose.from_quaternion(geodetic.rotation_wxyz, geodetic.translation).rotation
    return np.asarray(-rotation[2])


def circle_of(world: World | SetWorld) -> GeoCircle | None:
    """Return a circle about the middle of the map's extent that holds all of its landmarks.

    It is that of the extent's corners, so that no landmark has to be read; None where it is not
    known where the world lies.
    """
    geodetic = None if world.anchor is None else world.anchor.geodetic
    if geodetic is None:
        return None
    sides = zip(world.extent.min, world.extent.max, strict=True)
    corners = np.array(list(itertools.product(*sides)))
    local = enu_of(np.vstack([corners.mean(axis=0), corners]), geodetic)
    positions = geodetic_from_enu(local, origin_of(geodetic))
    # Across, in the plane at the middle: east and north of it.
    across = enu_from_geodetic(positions[1:], positions[0])[:, :2]
    radius = float(np.linalg.norm(across, axis=1).max())
    return GeoCircle(float(positions[0, 0]), float(positions[0, 1]), radius)
