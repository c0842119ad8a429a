"""Poses on Earth, in the words of OGC GeoPose 1.0."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field, model_validator

from visloc_api.words.base import Answer


class GeoPosition(Answer):
    """Where on Earth."""

    lat: Annotated[float, Field(description="degrees, WGS84")]
    lon: Annotated[float, Field(description="degrees")]
    h: Annotated[float, Field(description="metres above the ellipsoid, not above the sea")]


class GeoQuaternion(Answer):
    """A rotation as a unit quaternion, w >= 0."""

    x: float
    y: float
    z: float
    w: float


class GeoAngles(Answer):
    """Turns about z, the turned y and the twice turned x."""

    yaw: Annotated[float, Field(description="degrees within (-180, 180]: 0 looks east, 90 north")]
    pitch: Annotated[float, Field(description="degrees within [-90, 90]; positive looks down")]
    roll: Annotated[float, Field(description="degrees within (-180, 180]")]


class _OnEarth(Answer):
    """Latitude and longitude (degrees, WGS84) and height (m) beside their names in the standard."""

    position: GeoPosition

    @model_validator(mode="before")
    @classmethod
    def _from_parts(cls, values: Any) -> Any:
        if isinstance(values, dict) and "latitude" in values:
            lat, lon, h = (values[name] for name in ("latitude", "longitude", "height"))
            values = values | {"position": {"lat": lat, "lon": lon, "h": h}}
        return values

    @property
    def latitude(self) -> float:
        return self.position.lat

    @property
    def longitude(self) -> float:
        return self.position.lon

    @property
    def height(self) -> float:
        return self.position.h


class GeoPose(_OnEarth):
    """OGC GeoPose 1.0, Basic-Quaternion.

    It rotates the body's axes (x forward, y left, z up) to east, north and up at the position.
    """

    quaternion: GeoQuaternion

    @model_validator(mode="before")
    @classmethod
    def _from_tuple(cls, values: Any) -> Any:
        if isinstance(values, dict) and "quaternion_xyzw" in values:
            values = values | {
                "quaternion": dict(zip("xyzw", values["quaternion_xyzw"], strict=True))
            }
        return values

    @property
    def quaternion_xyzw(self) -> tuple[float, float, float, float]:
        q = self.quaternion
        return q.x, q.y, q.z, q.w


class GeoPoseYpr(_OnEarth):
    """OGC GeoPose 1.0, Basic-YPR: the same pose in angles."""

    angles: GeoAngles

    @model_validator(mode="before")
    @classmethod
    def _from_degrees(cls, values: Any) -> Any:
        if isinstance(values, dict) and "yaw_deg" in values:
            angles = {name: values[f"{name}_deg"] for name in ("yaw", "pitch", "roll")}
            values = values | {"angles": angles}
        return values

    @property
    def yaw_deg(self) -> float:
        return self.angles.yaw

    @property
    def pitch_deg(self) -> float:
        return self.angles.pitch

    @property
    def roll_deg(self) -> float:
        return self.angles.roll
