"""Poses on Earth, as OGC GeoPose 1.0 has them (OGC 21-056r11, Basic-Quaternion and Basic-YPR).

The body that is posed has x forward, y left and z up: at zero angles it looks east and stands
upright. A camera (x right, y down, z forward) becomes such a body by looking forward; so does a
rig, whose frame is read like a camera's. The outer frame is east, north and up at the body itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visloc.archive import Anchor, Geodetic
from visloc.archive.places import enu_of, origin_of
from visloc.geodesy import enu_from_ecef, geodetic_from_enu
from visloc.geometry import Pose
from visloc.pose.motion import position_covariance

# forward = z of the camera, left = -x, up = -y
_BODY_FROM_DEVICE = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
# Where the x axis is closer to the vertical than this (rad), yaw and roll turn about one axis.
_GIMBAL_LOCK = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class GeoPose:
    """Where a body is on Earth, and how it is turned.

    Attributes:
        latitude: degrees, WGS84.
        longitude: degrees.
        height: metres above the ellipsoid.
        enu_from_body: (3, 3), the body's axes east, north and up of the position.
    """

    latitude: float
    longitude: float
    height: float
    enu_from_body: NDArray[np.float64]

    @property
    def quaternion_wxyz(self) -> NDArray[np.float64]:
        """The rotation as a unit quaternion (w, x, y, z) with w >= 0, shape (4,)."""
        return Pose(self.enu_from_body, np.zeros(3)).rotation_wxyz

    @property
    def angles_deg(self) -> tuple[float, float, float]:
        """Yaw, pitch and roll: turns about z, the turned y and the twice turned x, in degrees.

        Yaw 0 looks east, 90 north; a positive pitch looks down. Yaw and roll are within
        (-180, 180], pitch within [-90, 90]; looking straight up or down, roll is 0.
        """
        r = self.enu_from_body
        level = math.hypot(r[0, 0], r[1, 0])
        pitch = math.atan2(-r[2, 0], level)
        if level < _GIMBAL_LOCK:
            return _half_open(math.atan2(-r[0, 1], r[1, 1])), math.degrees(pitch), 0.0
        yaw, roll = math.atan2(r[1, 0], r[0, 0]), math.atan2(r[2, 1], r[2, 2])
        return _half_open(yaw), math.degrees(pitch), _half_open(roll)


def geopose_of(device_from_world: Pose, geodetic: Geodetic) -> GeoPose:
    """Return the GeoPose of a camera, or of a rig.

    Args:
        geodetic: where the map's world lies.
    """
    anchor = origin_of(geodetic)
    position = geodetic_from_enu(enu_of(device_from_world.center[None], geodetic), anchor)[0]
    anchor_from_world = Pose.from_quaternion(geodetic.rotation_wxyz, geodetic.translation).rotation
    # East, north and up at the device are not those at the anchor: 10 km apart, 0.1 degrees.
    enu_from_world = enu_from_ecef(position) @ enu_from_ecef(anchor).T @ anchor_from_world
    enu_from_body = enu_from_world @ device_from_world.rotation.T @ _BODY_FROM_DEVICE.T
    latitude, longitude, height = position.tolist()
    return GeoPose(latitude, longitude, height, enu_from_body)


@dataclass(frozen=True, slots=True)
class GeoPoseAccuracy:
    """How sure a GeoPose is, as the OSCP GeoPose protocol has it.

    Attributes:
        position: metres, the mean of the standard deviations east, north and up.
        orientation: degrees, the mean of those about the device's three axes.
    """

    position: float
    orientation: float


def accuracy_of(
    device_from_world: Pose,
    covariance: NDArray[np.float64],
    anchor: Anchor,
) -> GeoPoseAccuracy:
    """Return the accuracy of a GeoPose; arguments as for ``earth_covariance``.

    The error of the place turns the device too.
    """
    position = np.sqrt(np.diag(earth_covariance(device_from_world, covariance, anchor)))
    geodetic = _placed(anchor)
    turns = covariance[:3, :3]
    if geodetic.error is not None:
        enu_from_world = Pose.from_quaternion(geodetic.rotation_wxyz, geodetic.translation)
        device_from_enu = device_from_world.rotation @ enu_from_world.rotation.T
        turn_of_place = np.array(geodetic.error.covariance)[:3, :3]
        turns = turns + device_from_enu @ turn_of_place @ device_from_enu.T
    orientation = np.degrees(np.sqrt(np.maximum(np.diag(turns), 0.0)))
    return GeoPoseAccuracy(float(position.mean()), float(orientation.mean()))


def earth_covariance(
    device_from_world: Pose, covariance: NDArray[np.float64], anchor: Anchor
) -> NDArray[np.float64]:
    """Return the covariance (3, 3) of a position on Earth, metres east, north and up.

    The sum of three, which are independent: that of the position in the map; that of the place of
    the map at this position, G C G^T with C of ``PlaceError`` and G of ``place_jacobian``; and that
    of one fix. The last because neighbouring fixes share errors, so that many of them do not
    average those out, and their scatter about the map does not show them. Where only the scatter
    (``rms``) is known, a third of its square goes to each axis.

    Args:
        covariance: (6, 6) of rotation (rad) then translation, for R <- Exp(w) R and t <- t + dt.
        anchor: what the map's place on Earth rests on.
    """
    geodetic = _placed(anchor)
    turn = Pose.from_quaternion(geodetic.rotation_wxyz, geodetic.translation).rotation
    in_map = turn @ position_covariance(device_from_world, covariance) @ turn.T
    if geodetic.error is None:
        fix = (anchor.rms or 0.0) ** 2 / 3 * np.eye(3)
        return np.asarray(geodetic.scale**2 * (in_map + fix))
    error = geodetic.error
    placed = enu_of(device_from_world.center[None], geodetic)
    gradient = place_jacobian(placed - np.array(error.middle))[0]
    of_place = gradient @ np.array(error.covariance) @ gradient.T
    fix = np.diag([error.level**2, error.level**2, error.up**2])
    return np.asarray(geodetic.scale**2 * in_map + of_place + fix)


def place_jacobian(offsets: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the derivatives (n, 3, 7) of positions on Earth by the parameters of ``PlaceError``.

    Args:
        offsets: (n, 3) of the positions from the middle of the fixes, metres east, north and up.
    """
    east, north, up = offsets.T
    zero = np.zeros(len(offsets))
    # w x offset, as a matrix times w.
    turns = np.array([[zero, up, -north], [-up, zero, east], [north, -east, zero]])
    moves = np.broadcast_to(np.eye(3), (len(offsets), 3, 3))
    return np.concatenate([turns.transpose(2, 0, 1), moves, offsets[:, :, None]], axis=2)


def _placed(anchor: Anchor) -> Geodetic:
    if anchor.geodetic is None:
        raise ValueError("the map has no place on Earth")
    return anchor.geodetic


def _half_open(angle: float) -> float:
    """Return an angle (rad) of [-pi, pi] in degrees within (-180, 180]."""
    degrees = math.degrees(angle)
    return 180.0 if degrees == -180.0 else degrees
