"""What can be asked of a server about rigs and sequences."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clients.features import Features
from clients.priors import priors_as_json, transform_as_json
from clients.requests import Request, Search, read_query
from clients.rigs import Instant, Odometry, Rig, RigImage
from visloc.errors import InvalidInput
from visloc.geometry import Camera, Pose
from visloc.priors import Priors, check_covariance
from visloc.trajectory import TimeUnit

_MAX_SCALE_ERROR = 1e-3  # of a rotation, as the server has it
_MAX_TIMESTAMP = 2**63


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
        InvalidInput: ``rig.rotation``, ``rig.timestamps``, ``pose.translation`` or
            ``image.unreadable``.
    """
    _check_rig(rig)
    return LocalizeRig(search, rig, tuple(map(_sent_image, images)))


def sequence_start(
    search: Search, rig: Rig | None, time_unit: str | None, max_gap_s: float | None
) -> SequenceStart:
    """Check what ``localize_sequence`` was called with.

    Raises:
        InvalidInput: ``rig.rotation``, ``pose.translation``, ``sequence.time_unit`` or
            ``sequence.max_gap``.
    """
    if rig is not None:
        _check_rig(rig)
    units = [unit.value for unit in TimeUnit]
    if time_unit is not None and time_unit not in units:
        raise InvalidInput(
            "sequence.time_unit",
            "unknown unit of timestamps",
            field="time_unit",
            expected=f"one of {', '.join(units)}",
            got=time_unit,
        )
    if max_gap_s is not None and not (math.isfinite(max_gap_s) and max_gap_s >= 0):
        raise InvalidInput(
            "sequence.max_gap",
            "not a time",
            field="max_gap_s",
            expected="seconds, 0 or more",
            got=max_gap_s,
        )
    return SequenceStart(search, rig, time_unit, max_gap_s)


def sent_instant(instant: Instant) -> SentInstant:
    """Check an instant and read its photos.

    Raises:
        InvalidInput: ``sequence.timestamps``, ``pose.rotation``, ``pose.translation``,
            ``pose.covariance`` or ``image.unreadable``.
    """
    _check_timestamp(instant.timestamp, "sequence.timestamps")
    odometry = instant.odometry
    if odometry is not None:
        _check_rigid(odometry.rig_from_odometry, "odometry.rig_from_odometry", "pose.rotation")
        if odometry.covariance is not None:
            check_covariance(np.asarray(odometry.covariance), "odometry.covariance")
    images = tuple(map(_sent_image, instant.images))
    return SentInstant(instant.timestamp, images, odometry, instant.priors)


def search_as_json(search: Search) -> dict[str, Any]:
    """Return what is searched as the API has it in JSON, without what is not given."""
    given: dict[str, Any] = (
        {"map": search.maps[0]} if len(search.maps) == 1 else {"maps": list(search.maps)}
    )
    if options := search.options.given():
        given["options"] = options
    if priors := priors_as_json(search.priors):
        given["priors"] = priors
    return given


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


def _sent_image(image: RigImage) -> SentImage:
    if image.timestamp is not None:
        _check_timestamp(image.timestamp, "rig.timestamps")
    return SentImage(image.sensor, read_query(image.query), image.camera, image.timestamp)


def _check_timestamp(timestamp: int, code: str) -> None:
    if isinstance(timestamp, bool) or not isinstance(timestamp, int):
        whole = False
    else:
        whole = -_MAX_TIMESTAMP <= timestamp < _MAX_TIMESTAMP
    if not whole:
        raise InvalidInput(
            code,
            "not a timestamp",
            field="timestamp",
            expected="a whole number of 64 bits",
            got=timestamp,
        )


def _check_rig(rig: Rig) -> None:
    if isinstance(rig, Mapping):
        for name, sensor in rig.items():
            _check_rigid(sensor.cam_from_rig, f"rig.sensors.{name}.cam_from_rig", "rig.rotation")


def _check_rigid(pose: Pose, field: str, code: str) -> None:
    # A quaternion is made of it, which would hide the scale.
    scale_error = np.abs(pose.rotation @ pose.rotation.T - np.eye(3)).max()
    if not (scale_error <= _MAX_SCALE_ERROR and np.linalg.det(pose.rotation) > 0):
        raise InvalidInput(
            code,
            "not a rotation: scaled, sheared or mirrored",
            field=field,
            expected="a rotation matrix",
            got=pose.rotation.tolist(),
        )
    if not np.isfinite(pose.translation).all():
        raise InvalidInput(
            "pose.translation",
            "not a translation",
            field=field,
            expected="three finite numbers",
            got=pose.translation.tolist(),
        )
