"""What can be asked of a server about rigs and sequences."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clients.wire.features import Features
from clients.wire.priors import checked_covariance, priors_as_json, transform_as_json
from clients.wire.requests import Request, Search, read_query
from clients.wire.rigs import Instant, Rig, RigImage
from visloc.errors import VislocError, refuse
from visloc.geometry import Camera, Pose
from visloc.priors import Priors
from visloc.sequences.filling import Odometry, TimeUnit, guess_time_unit
from visloc.types import Near, RigSensor

_MAX_SCALE_ERROR = 1e-3  # of a rotation, as the server has it
_MAX_TIMESTAMP = 2**63
_A_RIG = "the id of a rig that the map knows, or its cameras as RigSensor by name"


@dataclass(frozen=True, slots=True, eq=False)
class SentImage:
    """One photo of an instant, read."""

    sensor: str
    query: bytes | Features
    camera: Camera | None
    timestamp: int | None


@dataclass(frozen=True, slots=True, eq=False)
class LocalizeRig:
    """Localize the photos that a rig took at one instant; see ``rig_request``."""

    search: Search
    rig: Rig
    images: tuple[SentImage, ...]


AnyRequest = Request | LocalizeRig


@dataclass(frozen=True, slots=True, eq=False)
class SequenceStart:
    """What all instants of a sequence share; see ``sequence_start``."""

    search: Search
    rig: Rig | None
    time_unit: str | None
    max_gap_s: float | None


@dataclass(frozen=True, slots=True, eq=False)
class SentInstant:
    """One instant of a sequence, its photos read; see ``sent_instant``."""

    timestamp: int
    images: tuple[SentImage, ...]
    odometry: Odometry | None
    priors: Priors | None


def rig_request(search: Search, rig: Rig, images: Iterable[RigImage]) -> LocalizeRig:
    """Check and complete what ``localize_rig`` was called with; paths are read here.

    Raises:
        InvalidInput: ``request.missing_field`` or ``request.invalid`` for what is no rig or are
            no photos, ``rig.rotation``, ``rig.timestamps``, ``pose.translation`` or
            ``image.unreadable``.
    """
    if rig is None:  # from callers without a type checker
        raise refuse("request.missing_field", field="rig", expected=_A_RIG)
    _check_rig(rig)
    return LocalizeRig(search, rig, _sent_images(images))


def sequence_start(
    search: Search, rig: Rig | None, time_unit: str | None, max_gap_s: float | None
) -> SequenceStart:
    """Check what ``localize_sequence`` was called with.

    Raises:
        InvalidInput: ``request.invalid`` for what is no rig, ``rig.rotation``,
            ``pose.translation``, ``sequence.time_unit`` or ``sequence.max_gap``.
    """
    if rig is not None:
        _check_rig(rig)
    units = [unit.value for unit in TimeUnit]
    if time_unit is not None and time_unit not in units:
        raise refuse("sequence.time_unit", field="time_unit", expected=units, got=time_unit)
    if max_gap_s is not None and not (math.isfinite(max_gap_s) and max_gap_s >= 0):
        raise refuse(
            "sequence.max_gap", field="max_gap_s", expected="seconds, 0 or more", got=max_gap_s
        )
    return SequenceStart(search, rig, time_unit, max_gap_s)


def sent_instant(instant: Instant, index: int) -> SentInstant:
    """Check an instant of a sequence and read its photos.

    Args:
        instant: to send.
        index: of it in the sequence, for errors.

    Raises:
        InvalidInput: ``sequence.timestamps``, ``pose.rotation``, ``pose.translation``,
            ``pose.covariance``, ``request.invalid`` for what are no photos, or
            ``image.unreadable``.
    """
    where = f"instants[{index}]"
    _check_timestamp(instant.timestamp, "sequence.timestamps", f"{where}.timestamp")
    odometry = instant.odometry
    if odometry is not None:
        field = f"{where}.odometry"
        _check_rigid(odometry.rig_from_odometry, f"{field}.rig_from_odometry", "pose.rotation")
        if odometry.covariance is not None:
            checked_covariance(odometry.covariance, f"{field}.covariance")
    images = _sent_images(instant.images, f"{where}.")
    return SentInstant(instant.timestamp, images, odometry, instant.priors)


def check_time_unit(time_unit: str | None, first_timestamp: int) -> None:
    """Refuse a sequence whose unit of time is neither said nor told by its first timestamp.

    Raises:
        InvalidInput: ``sequence.time_unit``, as the server raises it.
    """
    if time_unit is None and guess_time_unit([first_timestamp]) is None:
        raise refuse(
            "sequence.time_unit",
            "the size of the timestamps does not reveal their unit",
            field="time_unit",
            expected=TimeUnit,
        )


def search_as_json(search: Search) -> dict[str, Any]:
    """Return what is searched as the API has it in JSON, without what is not given."""
    maps = search.maps
    given: dict[str, Any] = (
        {"near": near_as_json(maps)}
        if isinstance(maps, Near)
        else {"map": maps[0]}
        if len(maps) == 1
        else {"maps": list(maps)}
    )
    if options := search.options.given():
        given["options"] = options
    if priors := priors_as_json(search.priors):
        given["priors"] = priors
    if search.ypr:
        given["ypr"] = True
    return given


def near_as_json(near: Near) -> dict[str, float]:
    """Return a place as the API has it in JSON."""
    return {name: float(value) for name, value in asdict(near).items()}


def rig_as_json(rig: Rig) -> str | dict[str, Any]:
    """Return a rig as the API has it in JSON."""
    if isinstance(rig, str):
        return rig
    sensors: dict[str, dict[str, Any]] = {}
    for name, sensor in rig.items():
        sensors[name] = {"cam_from_rig": transform_as_json(sensor.cam_from_rig)}
        if sensor.camera is not None:
            sensors[name]["camera"] = camera_as_json(sensor.camera)
    return {"sensors": sensors}


def camera_as_json(camera: Camera) -> dict[str, Any]:
    """Return a camera as the API has it in JSON."""
    return {
        "model": camera.model,
        "width": camera.width,
        "height": camera.height,
        "params": list(camera.params),
    }


def odometry_as_json(odometry: Odometry) -> dict[str, Any]:
    """Return odometry as the API has it in JSON."""
    given: dict[str, Any] = {"rig_from_odometry": transform_as_json(odometry.rig_from_odometry)}
    if odometry.covariance is not None:
        covariance: NDArray[np.float64] = np.asarray(odometry.covariance, dtype=np.float64)
        given["covariance"] = covariance.ravel().tolist()
    return given


def _sent_images(images: Iterable[RigImage], where: str = "") -> tuple[SentImage, ...]:
    field = f"{where}images"
    if isinstance(images, Mapping) or not isinstance(images, Iterable):
        raise _unusable(field, "a list of RigImage", images)
    return tuple(_sent_image(image, f"{field}[{i}]") for i, image in enumerate(images))


def _sent_image(image: RigImage, field: str) -> SentImage:
    if not isinstance(image, RigImage):
        raise _unusable(field, "a RigImage", image)
    if image.timestamp is not None:
        _check_timestamp(image.timestamp, "rig.timestamps", f"{field}.timestamp")
    return SentImage(image.sensor, read_query(image.query), image.camera, image.timestamp)


def _check_timestamp(timestamp: int, code: str, field: str) -> None:
    if isinstance(timestamp, bool) or not isinstance(timestamp, int):
        whole = False
    else:
        whole = -_MAX_TIMESTAMP <= timestamp < _MAX_TIMESTAMP
    if not whole:
        raise refuse(
            code,
            "this is not a timestamp",
            field=field,
            expected="a whole number of 64 bits",
            got=timestamp,
        )


def _check_rig(rig: Rig) -> None:
    if isinstance(rig, str):
        return
    if not isinstance(rig, Mapping):
        raise _unusable("rig", _A_RIG, rig)
    for name, sensor in rig.items():
        field = f"rig.sensors.{name}"
        if not isinstance(sensor, RigSensor):
            raise _unusable(field, "a RigSensor", sensor)
        _check_rigid(sensor.cam_from_rig, f"{field}.cam_from_rig", "rig.rotation")


def _unusable(field: str, expected: str, got: object) -> VislocError:
    return refuse("request.invalid", field=field, expected=expected, got=type(got).__name__)


def _check_rigid(pose: Pose, field: str, code: str) -> None:
    # A quaternion is made of it, which would hide the scale.
    scale_error = np.abs(pose.rotation @ pose.rotation.T - np.eye(3)).max()
    if not (scale_error <= _MAX_SCALE_ERROR and np.linalg.det(pose.rotation) > 0):
        raise refuse(
            code,
            "the rotation is scaled, sheared or mirrored",
            field=field,
            expected="a rotation matrix",
            got=pose.rotation.tolist(),
        )
    if not np.isfinite(pose.translation).all():
        raise refuse(
            "pose.translation",
            field=field,
            expected="three finite numbers",
            got=pose.translation.tolist(),
        )
