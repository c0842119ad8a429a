"""The request for the images of a rig at one instant."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar

from pydantic import FailFast, Field

import service.values
import visloc.types
from service.api.geopose import GivenNear, GivenYpr
from service.api.localize import FeaturesField, GivenMaps, PhotoField, where_to_core
from service.values import ONLY_SENSOR, ImageJob, RigJob
from visloc.errors import inside, refuse
from visloc_api.words.features import query_to_core
from visloc_api.words.geometry import GivenCamera, Transform
from visloc_api.words.message import IncomingMessage, converted, counted
from visloc_api.words.options import GivenOptions, LocalizeOptions
from visloc_api.words.priors import GivenPriors, priors_to_core

# More than any rig has: it bounds what a request can make the server look at.
MAX_SENSORS = 256
MAX_ID = 100

Timestamp = Annotated[int, Field(ge=-(2**63), lt=2**63)]


@dataclass(frozen=True, slots=True)
class BatchLimits:
    """How much one request may hold.

    Attributes:
        max_images: of one instant.
        max_instants: of one sequence.
    """

    max_images: int
    max_instants: int


class Parts:
    """The files of a form, each of which is one image."""

    def __init__(self, files: Mapping[str, bytes]) -> None:
        self._names = tuple(files)
        self._left = dict(files)

    def take(self, name: str) -> bytes:
        """Return the file of an image.

        Raises:
            InvalidInput: ``request.part`` when it was not sent, or is another image's already.
        """
        if name not in self._left:
            raise refuse(
                "request.part",
                "another image already uses this part"
                if name in self._names
                else "no file part of this name was sent",
                field="part",
                expected=f"one of the file parts: {', '.join(self._left) or 'none is left'}"[:500],
                got=name,
            )
        return self._left.pop(name)

    def check_all_taken(self) -> None:
        """Refuse a file that no image names.

        Raises:
            InvalidInput: ``request.part``.
        """
        if self._left:
            name = next(iter(self._left))
            raise refuse(
                "request.part",
                "no image of the request names this part",
                field=name[:100],
                expected='an image with "part": NAME for every file',
                got=name,
            )


NO_PARTS: Mapping[str, bytes] = {}


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

    def to_core(self) -> Mapping[str, visloc.types.RigSensor]:
        """Return the rig, checked.

        Raises:
            InvalidInput: ``rig.empty``, ``rig.rotation``, ``pose.translation`` or ``camera...``.
        """
        if not self.sensors:
            raise refuse("rig.empty", field="rig.sensors", got="none")
        return {name: _sensor_to_core(name, sensor) for name, sensor in self.sensors.items()}


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


def rig_to_core(rig: str | RigCalibration) -> service.values.Rig:
    """Return the rig, checked."""
    return rig if isinstance(rig, str) else rig.to_core()


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
    part: Annotated[
        str | None, Field(description="in a form, instead of image: the name of the file's part")
    ] = None

    def to_core(self, parts: Parts, *, has_rig: bool) -> ImageJob:
        """Return the image, not decoded.

        Raises:
            InvalidInput: ``request.missing_field``, ``request.query``, ``request.part``,
                ``features...`` or ``camera...``.
        """
        if has_rig and not self.sensor:
            raise refuse("request.missing_field", field="sensor")
        image = self.image
        if self.part is not None:
            if image is not None or self.features is not None:
                raise refuse(
                    "request.query",
                    "an image must be given in exactly one way",
                    field="image",
                    expected="one of image, features, part",
                    got="part and another",
                )
            image = parts.take(self.part)
        return ImageJob(
            self.sensor or ONLY_SENSOR,
            query_to_core(image, self.features),
            None if self.camera is None else self.camera.to_core(),
        )


def _few_images(images: object, limits: object) -> None:
    if (
        isinstance(limits, BatchLimits)
        and isinstance(images, list)
        and len(images) > limits.max_images
    ):
        raise refuse(
            "rig.too_many_images",
            field="images",
            expected=f"at most {limits.max_images}",
            got=len(images),
        )


Images = Annotated[
    list[RigImage],
    FailFast(),
    counted(_few_images),
    Field(description="each of another sensor, all of one instant"),
]


def images_to_core(
    images: list[RigImage], timestamp: int | None, parts: Parts, *, has_rig: bool
) -> tuple[tuple[ImageJob, ...], int | None]:
    """Return the images of an instant, and its timestamp where one is known.

    Raises:
        InvalidInput: ``rig.timestamps`` for images of different instants, or a code of an image.
    """
    jobs = []
    for number, image in enumerate(images):
        with inside(f"images[{number}]"):
            if image.timestamp is not None and timestamp not in (None, image.timestamp):
                raise refuse(
                    "rig.timestamps",
                    field="timestamp",
                    expected=f"{timestamp}, as of the others",
                    got=image.timestamp,
                )
            timestamp = timestamp if image.timestamp is None else image.timestamp
            jobs.append(image.to_core(parts, has_rig=has_rig))
    return tuple(jobs), timestamp


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

    def to_job(self, files: Mapping[str, bytes] = NO_PARTS) -> RigJob:
        """Return the work to do.

        Args:
            files: the files of a form by the names of their parts.

        Raises:
            InvalidInput: ``request...``, ``near...``, ``rig...``, ``features...``,
                ``camera...``, ``options...``, ``priors...`` or ``pose...``.
        """
        where = where_to_core(self.map, self.maps, self.near)
        if self.rig is None:
            raise refuse("request.missing_field", field="rig")
        rig, parts = rig_to_core(self.rig), Parts(files)
        images, timestamp = images_to_core(self.images, None, parts, has_rig=True)
        parts.check_all_taken()
        return RigJob(
            where,
            rig,
            images,
            timestamp,
            self.options.to_core(),
            priors_to_core(self.priors),
            ypr=bool(self.ypr),
        )
