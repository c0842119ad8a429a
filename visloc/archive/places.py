"""Where a map lies on Earth, according to its manifest."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from visloc.archive.schema import Geodetic, World
from visloc.archive.set_schema import SetWorld
from visloc.errors import refuse
from visloc.geodesy import (
    ecef_from_geodetic,
    enu_from_ecef,
    geodetic_from_enu,
    ground_distance,
)
from visloc.geometry import Pose, Similarity
from visloc.priors import Priors


@dataclass(frozen=True, slots=True)
class GeoCircle:
    """A circle on Earth, WGS84: degrees, and a radius in metres."""

    latitude: float
    longitude: float
    radius: float

    def distance_to(self, latitude: float, longitude: float) -> float:
        """Distance from the circle to a position (deg) in metres; 0 within it."""
        middle = np.array([self.latitude, self.longitude, 0.0])
        return max(0.0, ground_distance(middle, np.array([latitude, longitude, 0.0])) - self.radius)


def enu_of(points: NDArray[np.float64], geodetic: Geodetic) -> NDArray[np.float64]:
    """Convert points (n, 3) of a world to metres (n, 3) east, north and up from its anchor."""
    enu_from_world = Pose.from_quaternion(geodetic.rotation_wxyz, geodetic.translation)
    return enu_from_world.apply(geodetic.scale * points)


def origin_of(geodetic: Geodetic) -> NDArray[np.float64]:
    """Return the anchor's position (3,): latitude, longitude (deg), altitude (m)."""
    return np.array([geodetic.latitude_deg, geodetic.longitude_deg, geodetic.altitude_m])


def anchor_rms(world: World | SetWorld) -> float:
    """Return the error of the world's place on Earth, in its unit; 0 when unknown."""
    return (world.anchor and world.anchor.rms) or 0.0


def similarity_on_earth(a: Geodetic, b: Geodetic) -> Similarity:
    """Return a_from_b of two worlds whose places on Earth are known."""
    axes_a, axes_b = enu_from_ecef(origin_of(a)), enu_from_ecef(origin_of(b))
    apart = ecef_from_geodetic(np.stack([origin_of(a), origin_of(b)]))
    enu_a_from_enu_b = Similarity(1.0, axes_a @ axes_b.T, axes_a @ (apart[1] - apart[0]))
    return _enu_from_world(a).inverse() @ enu_a_from_enu_b @ _enu_from_world(b)


def _enu_from_world(geodetic: Geodetic) -> Similarity:
    pose = Pose.from_quaternion(geodetic.rotation_wxyz, geodetic.translation)
    return Similarity(geodetic.scale, pose.rotation, pose.translation)


def located(priors: Priors, world: World | SetWorld) -> Priors:
    """Tell the GNSS prior where the world lies on Earth, unless somebody did.

    How well the map knows that (``Anchor.rms``) adds to the accuracy of the fix.
    """
    fix = priors.gnss
    if fix is None or fix.fix_from_world is not None:
        return priors
    geodetic = None if world.anchor is None else world.anchor.geodetic
    if geodetic is None:
        raise refuse("priors.gnss", field="priors.gnss")
    there = Geodetic(
        latitude_deg=fix.latitude, longitude_deg=fix.longitude, altitude_m=fix.altitude or 0.0
    )
    known = geodetic.scale * anchor_rms(world)
    vertical = fix.vertical_accuracy
    fix = replace(
        fix,
        accuracy=math.hypot(fix.accuracy, known),
        vertical_accuracy=None if vertical is None else math.hypot(vertical, known),
        fix_from_world=similarity_on_earth(there, geodetic),
    )
    return replace(priors, gnss=fix)


def down_of(geodetic: Geodetic) -> NDArray[np.float64]:
    """Return the unit vector (3,) that points down in a world."""
    rotation = Pose.from_quaternion(geodetic.rotation_wxyz, geodetic.translation).rotation
    return np.asarray(-rotation[2])


def circle_of(world: World | SetWorld) -> GeoCircle | None:
    """Return a circle about the middle of the map's extent that holds the corners of the extent.

    No landmark needs to be read. None when the world's place on Earth is unknown.
    """
    geodetic = None if world.anchor is None else world.anchor.geodetic
    if geodetic is None:
        return None
    box = np.array([[world.extent.min, world.extent.max]])
    return GeoCircle(*circles_of(box, geodetic)[0].tolist())


def circles_of(boxes: NDArray[np.float64], geodetic: Geodetic) -> NDArray[np.float64]:
    """Return circles on Earth that hold boxes of a world, each about the middle of its box.

    Args:
        boxes: (n, 2, 3) smallest and largest coordinates.

    Returns:
        (n, 3) latitude, longitude (deg) and radius (m).
    """
    which = np.array(list(itertools.product((0, 1), repeat=3)))
    corners = boxes[:, which, np.arange(3)]
    points = np.concatenate([boxes.mean(axis=1, keepdims=True), corners], axis=1)
    local = enu_of(points.reshape(-1, 3), geodetic)
    positions = geodetic_from_enu(local, origin_of(geodetic))
    middles = positions.reshape(points.shape)[:, 0]
    away = ecef_from_geodetic(positions).reshape(points.shape)
    away = away[:, 1:] - away[:, :1]
    # Horizontal distance: without the component along up at each middle.
    up = ecef_from_geodetic(middles + np.array([0.0, 0.0, 1.0])) - ecef_from_geodetic(middles)
    across = away - (away @ up[:, :, None]) * up[:, None]
    radii = np.linalg.norm(across, axis=2).max(axis=1)
    return np.column_stack([middles[:, :2], radii])
