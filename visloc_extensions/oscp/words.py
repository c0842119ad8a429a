"""Requests and answers of the OSCP GeoPose protocol, versions 1 and 2.

Clients differ in how they spell it, so reading is lenient: unknown fields are passed over, null is
absent, the version is told by the shape of ``sensorReadings``. Writing is strict.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import from_json

from service.values import ImageJob, RigJob, photo_job
from visloc.errors import inside, refuse
from visloc.geometry import Camera, Pose
from visloc.options import LocalizeOptions
from visloc.types import MAX_RADIUS_M, Near, RigSensor
from visloc_api.words.geopose import GeoPose
from visloc_api.words.json_text import check_json_values, check_names, utf8_json
from visloc_api.words.message import MAX_INSTANT_VALUES, refusal_of
from visloc_extensions.oscp.images import image_bytes

# A device is searched for so far around a position at least: cities make fixes worse than they say.
_MIN_RADIUS_M = 100.0
# A position is within its accuracy (95 %) in 19 of 20 cases, and within twice that nearly always.
_ACCURACIES = 2.0
# Names of the Wi-Fi readings and the like do not matter here; these are read.
_CAMERA, _GEOLOCATION = "camera", "geolocation"
_READING_KINDS = {_CAMERA: "cameraReadings", _GEOLOCATION: "geolocationReadings"}
_UNKNOWN_MODELS = ("", "UNKNOWN", "UNKNOWN_CAMERA")
_DEPTH = "DEPTH"
_MAX_SENSORS = 1000
_MAX_ID = 100  # characters of an id in an error

Numbers = Annotated[list[float], Field(fail_fast=True)]


class _Read(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class Quaternion(_Read):
    """A rotation."""

    x: float
    y: float
    z: float
    w: float


class Vector3(_Read):
    """A translation in metres."""

    x: float
    y: float
    z: float


class CameraParam(_Read):
    """Intrinsics, in COLMAP's order and without width and height."""

    model: str | None = None
    modelParams: Numbers | None = None  # noqa: N815  the protocol's name


class Sensor(_Read):
    """A sensor of the device."""

    id: str
    type: str | None = None
    rigIdentifier: str | None = None  # noqa: N815
    rigRotation: Quaternion | None = None  # noqa: N815
    rigTranslation: Vector3 | None = None  # noqa: N815
    params: CameraParam | None = None

    @property
    def cam_from_rig(self) -> Pose | None:
        """Where it sits on its rig; None when it is on none, or that is not said.

        Raises:
            InvalidInput: ``pose.rotation``, ``pose.translation``.
        """
        r, t = self.rigRotation, self.rigTranslation
        if self.rigIdentifier is None or r is None or t is None:
            return None
        with inside(f"sensors.{self.id[:_MAX_ID]}"):
            return Pose.from_quaternion((r.w, r.x, r.y, r.z), (t.x, t.y, t.z))


class CameraReading(_Read):
    """A photo."""

    timestamp: float | None = None
    sensorId: str | None = None  # noqa: N815
    imageFormat: str | None = None  # noqa: N815
    size: Numbers | None = None
    imageBytes: str  # noqa: N815
    params: CameraParam | None = None


class GeolocationReading(_Read):
    """A position of the device."""

    timestamp: float | None = None
    latitude: float | None = None
    longitude: float | None = None
    accuracy: float | None = None

    @property
    def circle(self) -> Near | None:
        """Where the device is; None when it is not said in numbers of this Earth."""
        latitude, longitude = self.latitude, self.longitude
        # NaN is none.
        if latitude is None or longitude is None or not abs(latitude) <= 90:
            return None
        if not abs(longitude) <= 180:
            return None
        accuracy = 0.0 if self.accuracy is None else self.accuracy
        # Negative, huge and NaN stand for "unknown".
        known = 0.0 <= accuracy <= MAX_RADIUS_M / _ACCURACIES
        radius = max(_MIN_RADIUS_M, _ACCURACIES * accuracy) if known else _MIN_RADIUS_M
        return Near(latitude, longitude, radius)


class GeoPoseRequest(_Read):
    """What both versions ask, in the shape of version 2."""

    id: str | None = None
    timestamp: int | float | None = None
    sensors: list[Sensor] = []
    cameras: list[CameraReading] = []
    positions: list[GeolocationReading] = []

    @classmethod
    def read_json(cls, text: str | bytes) -> Self:
        """Check a request written as JSON."""
        text = utf8_json(text)
        check_json_values(text, MAX_INSTANT_VALUES)
        try:
            body = from_json(text, allow_inf_nan=False)
        except ValueError:
            raise refuse("request.malformed", expected="JSON") from None
        check_names(text)
        body = _object(body, "")
        readings = body.get("sensorReadings")
        sensors = _list(body.get("sensors"), "sensors")
        if isinstance(readings, list):
            by_kind = _readings_of_version_1(readings, sensors)
        else:
            readings = _object({} if readings is None else readings, "sensorReadings")
            by_kind = {
                kind: _list(readings.get(name), f"sensorReadings.{name}")
                for kind, name in _READING_KINDS.items()
            }
        positions = [*by_kind[_GEOLOCATION]]
        if not positions:
            positions = _prior_positions(_list(body.get("priorPoses"), "priorPoses"))
        given = {
            "id": body.get("id") if isinstance(body.get("id"), str) else None,
            "timestamp": _finite(body.get("timestamp")),
            "sensors": sensors,
            "cameras": by_kind[_CAMERA],
            "positions": positions,
        }
        try:
            return cls.model_validate(given)
        except ValidationError as refused:
            raise refusal_of(_in_its_words(refused)) from None

    def to_job(self, *, max_image_bytes: int, max_images: int) -> RigJob:
        """Return the work to do: of one photo, or of those of a rig at one instant.

        Photos that do not belong to the rig and the instant of the first are passed over: its
        pose is the answer.

        Args:
            max_image_bytes: largest photo.
        """
        sensors = {sensor.id: sensor for sensor in reversed(self.sensors)}
        photos = [
            (number, reading, sensors.get(reading.sensorId or ""))
            for number, reading in enumerate(self.cameras)
            if (reading.imageFormat or "").upper() != _DEPTH
        ]
        if not photos:
            raise refuse("geopose.no_camera", field="sensorReadings")
        near, options = self._near(), LocalizeOptions()
        rig = _rig_of(photos)
        if len(rig) > max_images:
            raise refuse(
                "rig.too_many_images",
                field="sensorReadings",
                expected=f"at most {max_images}",
                got=len(rig),
            )
        if len(rig) < 2:
            number, reading, sensor = photos[0]
            with inside(_place_of(number)):
                image = image_bytes(
                    reading.imageBytes, reading.imageFormat, _size(reading), max_image_bytes
                )
                return photo_job(near, image, _camera(reading, sensor), options)
        mounted: dict[str, RigSensor] = {}
        images = []
        for number, reading, sensor in rig:
            with inside(_place_of(number)):
                assert sensor is not None  # it is on the rig
                cam_from_rig = sensor.cam_from_rig
                assert cam_from_rig is not None
                image = image_bytes(
                    reading.imageBytes, reading.imageFormat, _size(reading), max_image_bytes
                )
                mounted[sensor.id] = RigSensor(cam_from_rig, None)
                images.append(ImageJob(sensor.id, image, _camera(reading, sensor)))
        return RigJob(near, mounted, tuple(images), None, options)

    def _near(self) -> Near:
        """Return where to search: around the latest position, or everywhere."""
        circles = [
            (position.timestamp or -math.inf, circle)
            for position in self.positions
            if (circle := position.circle) is not None
        ]
        if not circles:
            return Near(0.0, 0.0, MAX_RADIUS_M)
        return max(circles, key=lambda timed: timed[0])[1]


class GeoPoseAccuracy(BaseModel):
    """The accuracy of a GeoPose: mean standard deviations, not radii."""

    position: Annotated[float, Field(description="metres, the mean of east, north and up")]
    orientation: Annotated[float, Field(description="degrees, the mean of the three axes")]


class GeoPoseResponse(BaseModel):
    """The answer of the OSCP GeoPose protocol, the same in versions 1 and 2."""

    id: Annotated[str, Field(description="of the request")]
    timestamp: Annotated[
        int | float, Field(description="of the request, milliseconds since the Unix epoch")
    ]
    accuracy: GeoPoseAccuracy
    type: Literal["geopose"] = "geopose"
    geopose: Annotated[
        GeoPose,
        Field(
            description="of the camera of the first camera reading; rotates x forward, y left, z "
            "up to east, north, up"
        ),
    ]


class GeoPoseStatus(BaseModel):
    """The answer to GET."""

    status: Literal["running"] = "running"


def _place_of(camera_reading: int) -> str:
    return f"sensorReadings.{_READING_KINDS[_CAMERA]}[{camera_reading}]"


_Photo = tuple[int, CameraReading, Sensor | None]


def _rig_of(photos: Sequence[_Photo]) -> list[_Photo]:
    """Return the photos of the first one's rig and instant, one of each sensor."""
    _, first, first_sensor = photos[0]
    if first_sensor is None or first_sensor.cam_from_rig is None:
        return []
    found: dict[str, _Photo] = {}
    for photo in photos:
        _, reading, sensor = photo
        if (
            sensor is not None
            and sensor.rigIdentifier == first_sensor.rigIdentifier
            and sensor.cam_from_rig is not None
            and reading.timestamp == first.timestamp
        ):
            found.setdefault(sensor.id, photo)
    return list(found.values())


def _size(reading: CameraReading) -> tuple[int, int] | None:
    if not reading.size:
        return None
    sides = [int(side) for side in reading.size if math.isfinite(side) and side == int(side)]
    if len(sides) != 2 or len(reading.size) != 2 or min(sides) < 1:
        raise refuse(
            "request.invalid",
            "the size is not the size of a photo",
            field="size",
            expected="width and height in pixels",
            got=str(reading.size[:4]),
        )
    return sides[0], sides[1]


def _camera(reading: CameraReading, sensor: Sensor | None) -> Camera | None:
    """Return the intrinsics, of the reading or else of its sensor; None when unknown."""
    params = reading.params
    if params is None and sensor is not None:
        params = sensor.params
    if params is None or params.modelParams is None:
        return None
    model = (params.model or "").upper()
    if model in _UNKNOWN_MODELS:
        return None
    size = _size(reading)
    if size is None:
        raise refuse(
            "request.missing_field",
            "the intrinsics of a camera require the size of its photo",
            field="size",
            expected="width and height in pixels",
        )
    return Camera(model, *size, tuple(params.modelParams))


def _readings_of_version_1(
    readings: Sequence[object], sensors: Sequence[object]
) -> dict[str, list[object]]:
    """Sort readings by what they hold; of what their sensor is, where they do not tell."""
    types = {
        sensor.get("id"): str(sensor.get("type")).lower()
        for sensor in sensors
        if isinstance(sensor, dict) and isinstance(sensor.get("id"), str)
    }
    by_kind: dict[str, list[object]] = {kind: [] for kind in _READING_KINDS}
    for number, wrapped in enumerate(readings):
        envelope = _object(wrapped, f"sensorReadings[{number}]")
        reading = envelope.get("reading")
        if reading is None:
            continue
        reading = _object(reading, f"sensorReadings[{number}].reading")
        sensor_id = envelope.get("sensorId")
        kind = types.get(sensor_id) if isinstance(sensor_id, str) else None
        if kind not in by_kind and "imageBytes" in reading:
            kind = _CAMERA
        elif kind not in by_kind and "latitude" in reading:
            kind = _GEOLOCATION
        if kind in by_kind:
            by_kind[kind].append(
                {**reading, "timestamp": envelope.get("timestamp"), "sensorId": sensor_id}
            )
    return by_kind


def _prior_positions(poses: Sequence[object]) -> list[object]:
    """Return prior poses, which are responses or bare GeoPoses, as positions."""
    found: list[object] = []
    for number, pose in enumerate(poses):
        prior = _object(pose, f"priorPoses[{number}]")
        bare = prior.get("geopose") or prior
        position = bare.get("position") if isinstance(bare, dict) else None
        if not isinstance(position, dict) or not {"lat", "lon"} <= position.keys():
            continue
        accuracy = prior.get("accuracy")
        found.append(
            {
                "timestamp": _finite(prior.get("timestamp")),
                "latitude": position["lat"],
                "longitude": position["lon"],
                "accuracy": accuracy.get("position") if isinstance(accuracy, dict) else None,
            }
        )
    return found


def _in_its_words(refused: ValidationError) -> Mapping[str, Any]:
    """Return the first complaint, placed where it is in the request."""
    complaint = refused.errors(include_url=False)[0]
    where = complaint["loc"]
    names = {
        "cameras": ("sensorReadings", _READING_KINDS[_CAMERA]),
        "positions": ("sensorReadings", _READING_KINDS[_GEOLOCATION]),
    }
    if where and where[0] in names:
        where = (*names[str(where[0])], *where[1:])
    return {**complaint, "loc": where}


def _object(value: object, field: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise refuse(
            "request.invalid", field=field or None, expected="an object", got=type(value).__name__
        )
    return value


def _list(value: object, field: str) -> list[object]:
    if value is None:
        return []
    if not isinstance(value, list) or len(value) > _MAX_SENSORS:
        raise refuse(
            "request.invalid",
            field=field,
            expected=f"a list of at most {_MAX_SENSORS}",
            got=f"{len(value)} in it" if isinstance(value, list) else type(value).__name__,
        )
    return value


def _finite(value: object) -> int | float | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    # Infinite, or a whole number that no clock shows.
    return value if abs(value) < 2**63 and np.isfinite(float(value)) else None
