"""Poses on Earth, in the words of OGC GeoPose 1.0."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, Field

from service.api.message import IncomingMessage, converted
from service.values import Near as NearCore
from visloc.archive import Geodetic
from visloc.errors import refuse
from visloc.geometry import Pose
from visloc.geopose import geopose_of

# Half of the Earth's girth reaches everywhere.
MAX_RADIUS_M = 20_050_000.0


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
        for name, low, high in (
            ("latitude", -90.0, 90.0),
            ("longitude", -180.0, 180.0),
            ("radius", 0.0, MAX_RADIUS_M),
        ):
            value = getattr(self, name)
            # NaN fails too.
            if not low <= value <= high or (name == "radius" and value == 0):
                raise refuse(
                    f"near.{name}",
                    field=f"near.{name}",
                    expected=(
                        f"more than 0, at most {high:.0f} metres"
                        if name == "radius"
                        else f"{low:g} to {high:g} degrees"
                    ),
                    got=value,
                )
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


class GeoPosition(BaseModel):
    """Where on Earth."""

    lat: Annotated[float, Field(description="degrees, WGS84")]
    lon: Annotated[float, Field(description="degrees")]
    h: Annotated[float, Field(description="metres above the ellipsoid, not above the sea")]


class GeoQuaternion(BaseModel):
    """A rotation as a unit quaternion, w >= 0."""

    x: float
    y: float
    z: float
    w: float


class GeoAngles(BaseModel):
    """Turns about z, the turned y and the twice turned x."""

    yaw: Annotated[float, Field(description="degrees within (-180, 180]: 0 looks east, 90 north")]
    pitch: Annotated[float, Field(description="degrees within [-90, 90]; positive looks down")]
    roll: Annotated[float, Field(description="degrees within (-180, 180]")]


class GeoPose(BaseModel):
    """OGC GeoPose 1.0, Basic-Quaternion.

    It rotates the body's axes (x forward, y left, z up) to east, north and up at the position.
    """

    position: GeoPosition
    quaternion: GeoQuaternion


class GeoPoseYpr(BaseModel):
    """OGC GeoPose 1.0, Basic-YPR: the same pose in angles."""

    position: GeoPosition
    angles: GeoAngles


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
