"""Poses on Earth, in the words of OGC GeoPose 1.0."""

from __future__ import annotations

from visloc.archive import Geodetic
from visloc.geometry import Pose
from visloc.geopose import geopose_of
from visloc_api.words.geopose import GeoAngles, GeoPose, GeoPoseYpr, GeoPosition, GeoQuaternion


def geoposes_to_words(
    device_from_world: Pose | None, geodetic: Geodetic | None, *, ypr: bool
) -> tuple[GeoPose | None, GeoPoseYpr | None]:
    """Say a pose as GeoPoses: in a quaternion, and in angles where they are wanted.

    Both are None without a pose, and in a map that is not anchored to the Earth.
    """
    if device_from_world is None or geodetic is None:
        return None, None
    geopose = geopose_of(device_from_world, geodetic)
    position = GeoPosition(lat=geopose.latitude, lon=geopose.longitude, h=geopose.height)
    w, x, y, z = geopose.quaternion_wxyz.tolist()
    yaw, pitch, roll = geopose.angles_deg
    angles = GeoAngles(yaw=yaw, pitch=pitch, roll=roll)
    return (
        GeoPose(position=position, quaternion=GeoQuaternion(x=x, y=y, z=z, w=w)),
        GeoPoseYpr(position=position, angles=angles) if ypr else None,
    )
