"""Poses on Earth, as answers of maps that are anchored there have them (OGC GeoPose 1.0)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class GeoPose:
    """Where a camera, or a rig, is on Earth, and how it is turned.

    Attributes:
        latitude: degrees, WGS84.
        longitude: degrees.
        height: metres above the ellipsoid.
        quaternion_xyzw: rotates the body's axes (x forward, y left, z up) to east, north and up
            there; w >= 0.
    """

    latitude: float
    longitude: float
    height: float
    quaternion_xyzw: tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class GeoPoseYpr:
    """The same in angles, turns about z, the turned y and the twice turned x.

    Attributes:
        latitude: degrees, WGS84.
        longitude: degrees.
        height: metres above the ellipsoid.
        yaw_deg: 0 looks east, 90 north.
        pitch_deg: positive looks down.
        roll_deg: about the direction of view.
    """

    latitude: float
    longitude: float
    height: float
    yaw_deg: float
    pitch_deg: float
    roll_deg: float


def parse_geopose(raw: Mapping[str, Any] | None) -> GeoPose | None:
    """Parse a GeoPose; None when the map is not anchored, or there is no pose."""
    if raw is None:
        return None
    x, y, z, w = (float(raw["quaternion"][name]) for name in "xyzw")
    return GeoPose(*_position(raw), (x, y, z, w))


def parse_geopose_ypr(raw: Mapping[str, Any] | None) -> GeoPoseYpr | None:
    """Parse a GeoPoseYpr; None also when it was not asked for."""
    if raw is None:
        return None
    yaw, pitch, roll = (float(raw["angles"][name]) for name in ("yaw", "pitch", "roll"))
    return GeoPoseYpr(*_position(raw), yaw, pitch, roll)


def _position(raw: Mapping[str, Any]) -> tuple[float, float, float]:
    lat, lon, height = (float(raw["position"][name]) for name in ("lat", "lon", "h"))
    return lat, lon, height
