"""Poses on Earth, in the words of OGC GeoPose 1.0."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from visloc.archive import Geodetic
from visloc.errors import refuse
from visloc.geometry import Pose
from visloc.geopose import geopose_of
from visloc.types import Near as NearCore
from visloc_api.words.geopose import GeoAngles, GeoPose, GeoPoseYpr, GeoPosition, GeoQuaternion
from visloc_api.words.message import IncomingMessage, converted


class Near(IncomingMessage):
    """Where the device is on Earth, roughly."""

    latitude: Annotated[float, Field(description="degrees, WGS84")]
    longitude: Annotated[float, Field(description="degrees")]
    radius: Annotated[float, Field(description="metres, more than 0")]

    def to_core(self) -> NearCore:
        """Return the circle, checked.

        Raises:
            InvalidInput: ``near.latitude``, ``near.longitude`` or ``near.radius``.
        """
        return NearCore(self.latitude, self.longitude, self.radius)


def _near_from_text(value: object) -> object:
    """Read latitude,longitude,radius, or an object in JSON, as forms have it."""
    if not isinstance(value, str):
        return value
    if value.lstrip().startswith("{"):
        return Near.read_json(value)
    return near_from_text(value)


def near_from_text(text: str) -> Near:
    """Parse ``latitude,longitude,radius``.

    Raises:
        InvalidInput: ``near.syntax``.
    """
    try:
        latitude, longitude, radius = (float(number) for number in text.split(","))
    except ValueError:
        raise refuse("near.syntax", field="near", got=text) from None
    return Near(latitude=latitude, longitude=longitude, radius=radius)


# A place as an object, or as text in a field of a form.
GivenNear = Annotated[
    Near | None,
    converted(_near_from_text),
    Field(description="instead of map: search the maps that are anchored there"),
]


def flag_from_text(value: object) -> object:
    """Read true or false, as forms have them."""
    return {"true": True, "false": False}.get(value, value) if isinstance(value, str) else value


GivenYpr = Annotated[
    bool | None,
    converted(flag_from_text),
    Field(description="also say the GeoPose in yaw, pitch and roll"),
]


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
