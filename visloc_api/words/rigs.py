"""The request for the images of a rig at one instant."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar

from pydantic import BeforeValidator, FailFast, Field

import visloc.types
from visloc.errors import inside, refuse
from visloc_api.words.message import IncomingMessage, converted, counted
from visloc_api.words.near import GivenNear
from visloc_api.words.options import GivenOptions, LocalizeOptions
from visloc_api.words.photo import FeaturesField, GivenMaps, GivenYpr, MaskField, PhotoField
from visloc_api.words.poses import Camera, GivenCamera, Transform
from visloc_api.words.priors import GivenPriors

# More than any rig has: it bounds what a request can make the server look at.
MAX_SENSORS = 256
MAX_ID = 100

Timestamp = Annotated[int, Field(ge=-(2**63), lt=2**63)]


@dataclass(frozen=True, slots=True)
class BatchLimits:
    """How much one request may hold."""

    max_images: int
    max_instants: int


class RigSensor(IncomingMessage):
    """One camera of a rig."""

    cam_from_rig: Annotated[Transform, Field(description="its pose in the rig")]
    camera: Annotated[
        GivenCamera, Field(description="intrinsics of its photos, where they are known")
    ] = None


def _check_id(value: object, field: str) -> None:
    """Refuse the id of a rig or a sensor that no answer or error could name."""
    if isinstance(value, str) and len(value) > MAX_ID:
        raise refuse(
            "rig.id",
            field=field,
            expected=f"at most {MAX_ID} characters",
            got=f"{len(value)} characters",
        )


def _sensors_in_bounds(value: object) -> object:
    if isinstance(value, dict):
        if len(value) > MAX_SENSORS:
            raise refuse(
                "rig.too_many_sensors",
                field="sensors",
                expected=f"at most {MAX_SENSORS}",
                got=len(value),
            )
        for name in value:
            _check_id(name, "sensors")
    return value


def _sensor_id(value: object) -> object:
    _check_id(value, "sensor")
    return value


class RigCalibration(IncomingMessage):
    """The poses of the cameras in a rig."""

    path: ClassVar[str] = "rig."

    sensors: Annotated[
        dict[str, RigSensor], converted(_sensors_in_bounds), Field(description="by the sensor's id")
    ]

    @staticmethod
    def from_core(sensors: Mapping[str, visloc.types.RigSensor]) -> RigCalibration:
        """Say the poses of cameras that nobody has checked yet."""
        return RigCalibration(
            sensors={name: _sensor_from_core(name, sensor) for name, sensor in sensors.items()}
        )

    def to_core(self) -> Mapping[str, visloc.types.RigSensor]:
        """Return the rig, checked."""
        if not self.sensors:
            raise refuse("rig.empty", field="rig.sensors", got="none")
        return {name: _sensor_to_core(name, sensor) for name, sensor in self.sensors.items()}


def _sensor_from_core(name: str, sensor: visloc.types.RigSensor) -> RigSensor:
    camera = None if sensor.camera is None else Camera.from_core(sensor.camera)
    field = f"rig.sensors.{name}.cam_from_rig"
    transform = Transform.checked(sensor.cam_from_rig, field, "rig.rotation")
    return RigSensor(cam_from_rig=transform, camera=camera)


def _sensor_to_core(name: str, sensor: RigSensor) -> visloc.types.RigSensor:
    with inside(f"rig.sensors.{name}"):
        return visloc.types.RigSensor(
            sensor.cam_from_rig.to_core("cam_from_rig", "rig.rotation"),
            None if sensor.camera is None else sensor.camera.to_core(),
        )


def _rig_from_object(value: object) -> object:
    _check_id(value, "rig")
    if value is None or isinstance(value, str | RigCalibration):
        return value
    return RigCalibration.read(value)


# A rig by the id under which the map knows it, or as it is.
GivenRig = Annotated[
    str | RigCalibration | None,
    converted(_rig_from_object),
    Field(description="the id of a rig that the map knows, or the rig's sensors"),
]


class RigImage(IncomingMessage):
    """One image of an instant."""

    sensor: Annotated[
        str | None,
        converted(_sensor_id),
        Field(description="a camera of the rig; may be left out without a rig"),
    ] = None
    image: PhotoField = None
    features: FeaturesField = None
    camera: Annotated[
        GivenCamera,
        Field(
            description="if left out: the camera of this sensor in the rig (in the map, for a rig "
            "given by id); else the server takes the focal length from EXIF, else "
            "estimates or guesses it; the answer says which"
        ),
    ] = None
    timestamp: Annotated[
        Timestamp | None, Field(description="equal for all images of an instant")
    ] = None
    mask: MaskField = None
    part: Annotated[
        str | None, Field(description="in a form, instead of image: the name of the file's part")
    ] = None
    mask_part: Annotated[
        str | None, Field(description="in a form, instead of mask: the name of the file's part")
    ] = None


def at_most(limit: str, code: str, field: str) -> BeforeValidator:
    """Refuse a list beyond a limit of ``BatchLimits`` before its parts are validated."""

    def check(parts: object, limits: object) -> None:
        if not isinstance(limits, BatchLimits) or not isinstance(parts, list):
            return
        most = getattr(limits, limit)
        if len(parts) > most:
            raise refuse(code, field=field, expected=f"at most {most}", got=len(parts))

    return counted(check)


Images = Annotated[
    list[RigImage],
    FailFast(),
    at_most("max_images", "rig.too_many_images", "images"),
    Field(description="each of another sensor, all of one instant"),
]


class LocalizeRigRequest(IncomingMessage):
    """The images of a rig at one instant, and the map to search."""

    map: Annotated[str | None, Field(description="id, or id@version")] = None
    maps: GivenMaps = None
    rig: GivenRig
    images: Images
    options: GivenOptions = Field(default_factory=LocalizeOptions)
    priors: GivenPriors = None
    near: GivenNear = None
    ypr: GivenYpr = None
