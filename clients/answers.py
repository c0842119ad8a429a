"""From the plain JSON that every transport gives to the types that callers get."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from clients.errors import not_understood
from clients.requests import JsonObject
from clients.types import (
    CameraUsed,
    LocalizeResult,
    MapInfo,
    MapVersion,
    Orientation,
    PoseEstimate,
    Refusal,
    RetrievedImage,
    ServerInfo,
)
from visloc.errors import InvalidInput
from visloc.geometry import Camera, Pose

_T = TypeVar("_T")


def parse_answer(server: str, parse: Callable[[JsonObject], _T], raw: JsonObject) -> _T:
    """Parse an answer, and blame the server for one that cannot be.

    Raises:
        Unavailable: ``server.answer``.
    """
    try:
        return parse(raw)
    except (KeyError, TypeError, ValueError, InvalidInput) as error:
        raise not_understood(server, f"{type(error).__name__}: {error}") from error


def parse_result(raw: JsonObject) -> LocalizeResult:
    """Parse a LocalizeResponse."""
    pose = None if raw["pose"] is None else parse_pose(raw["pose"])
    refusal = None if raw["refusal"] is None else _parse_refusal(raw["refusal"])
    if (raw["status"] == "localized", pose is None, refusal is None) not in (
        (True, False, True),
        (False, True, False),
    ):
        raise ValueError(f"status {raw['status']!r} does not fit pose and refusal")
    return LocalizeResult(
        request_id=raw["request_id"],
        pose=pose,
        refusal=refusal,
        keypoints=int(raw["keypoints"]),
        correspondences=int(raw["correspondences"]),
        inliers=int(raw["inliers"]),
        inlier_ratio=float(raw["inlier_ratio"]),
        retrieved=tuple(
            RetrievedImage(
                image["image"], float(image["score"]), _numbers_by_name(image["similarities"])
            )
            for image in raw["retrieved"]
        ),
        camera=CameraUsed(_parse_camera(raw["camera"]), raw["camera"]["source"]),
        orientation=Orientation(int(raw["orientation"]["exif"]), raw["orientation"]["read_as"]),
        map=MapVersion(raw["map"]["id"], raw["map"]["version"]),
        seconds=_numbers_by_name(raw["seconds"]),
        raw=raw,
    )


def parse_pose(raw: JsonObject) -> PoseEstimate:
    """Parse a PoseEstimate."""
    transform = raw["cam_from_world"]
    w, x, y, z = (float(value) for value in transform["rotation_wxyz"])
    tx, ty, tz = (float(value) for value in transform["translation"])
    return PoseEstimate(
        cam_from_world=Pose.from_quaternion((w, x, y, z), (tx, ty, tz)),
        rotation_wxyz=(w, x, y, z),
        translation=(tx, ty, tz),
        position=_array(raw["position"], 3),
        orientation=_array(raw["orientation"], 4),
        covariance=_array(raw["covariance"], 6, 6),
        position_std=_array(raw["position_std"], 3),
        orientation_std_deg=_array(raw["orientation_std_deg"], 3),
    )


def parse_maps(raw: JsonObject) -> list[MapInfo]:
    """Parse a ListMapsResponse."""
    return [parse_map(info) for info in raw["maps"]]


def parse_map(raw: JsonObject) -> MapInfo:
    """Parse a MapInfo."""
    extent = raw["extent"]
    return MapInfo(
        id=raw["id"],
        version=raw["version"],
        created=raw["created"],
        metric=bool(raw["metric"]),
        method=raw["method"],
        local_features=raw["local_features"],
        global_features=tuple(raw["global_features"]),
        images=int(raw["images"]),
        landmarks=int(raw["landmarks"]),
        observations=int(raw["observations"]),
        extent=(_numbers(extent["min"]), _numbers(extent["max"])),
        size_bytes=int(raw["size_bytes"]),
    )


def parse_server(raw: JsonObject) -> ServerInfo:
    """Parse what a server says of itself."""
    return ServerInfo(raw["version"])


def parse_ready(raw: JsonObject) -> bool:
    """Parse whether a server can answer now."""
    return bool(raw["ready"])


def _parse_refusal(raw: JsonObject) -> Refusal:
    return Refusal(raw["stage"], raw["reason"], raw["message"])


def _parse_camera(raw: JsonObject) -> Camera:
    return Camera(raw["model"], int(raw["width"]), int(raw["height"]), _numbers(raw["params"]))


def _numbers(values: Sequence[Any]) -> tuple[float, ...]:
    return tuple(float(value) for value in values)


def _numbers_by_name(values: Mapping[str, Any]) -> dict[str, float]:
    return {name: float(value) for name, value in values.items()}


def _array(values: Sequence[Any], *shape: int) -> NDArray[np.float64]:
    return np.array(_numbers(values)).reshape(shape)
