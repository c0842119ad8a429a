"""From the plain JSON that every transport gives to the types that callers get."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from clients.errors import INTERNAL, not_understood, received
from clients.wire.geopose import parse_geopose, parse_geopose_ypr
from clients.wire.requests import JsonObject
from clients.wire.rigs import ImageResult, InstantResult, RigPose
from clients.wire.types import (
    Anchor,
    CameraUsed,
    Debug,
    GeoCircle,
    Geodetic,
    LocalizeResult,
    MapInfo,
    MapVersion,
    Orientation,
    PoseEstimate,
    Refusal,
    RetrievedImage,
    RigInfo,
    ServerInfo,
    TileInfo,
    VersionInfo,
)
from visloc.errors import InvalidInput
from visloc.geometry import Camera, Pose
from visloc.sequences.filling import PoseSource

_P = ParamSpec("_P")
_T = TypeVar("_T")


def parse_answer(server: str, parse: Callable[_P, _T], *given: _P.args, **named: _P.kwargs) -> _T:
    """Parse an answer, and blame the server for one that cannot be.

    Raises:
        Unavailable: ``server.answer``.
    """
    try:
        return parse(*given, **named)
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
        retrieved=_parse_retrieved(raw["retrieved"]),
        camera=_parse_camera_used(raw["camera"]),
        orientation=_parse_orientation(raw["orientation"]),
        map=MapVersion(raw["map"]["id"], raw["map"]["version"]),
        seconds=_numbers_by_name(raw["seconds"]),
        raw=raw,
        # A server that does not know them leaves them out.
        geopose=parse_geopose(raw.get("geopose")),
        geopose_ypr=parse_geopose_ypr(raw.get("geopose_ypr")),
        debug=_parse_debug(raw.get("debug")),
        tile=raw.get("tile"),
    )


def parse_pose(raw: JsonObject) -> PoseEstimate:
    """Parse a PoseEstimate."""
    rotation_wxyz, translation = _parse_transform(raw["cam_from_world"])
    return PoseEstimate(
        Pose.from_quaternion(rotation_wxyz, translation),
        rotation_wxyz,
        translation,
        **_parse_uncertainty(raw),
    )


def parse_instant(raw: JsonObject) -> InstantResult:
    """Parse an InstantAnswer."""
    status = raw["status"]
    pose = None if raw["pose"] is None else _parse_rig_pose(raw["pose"])
    refusal = None if raw["refusal"] is None else _parse_refusal(raw["refusal"])
    source = None if raw["source"] is None else PoseSource(raw["source"])
    is_estimated = source is PoseSource.ESTIMATED
    if (status, pose is None, refusal is None, source is None, is_estimated) not in (
        ("localized", False, True, False, True),
        ("filled", False, False, False, False),
        ("not_localized", True, False, True, False),
    ):
        raise ValueError(f"status {status!r} does not fit pose, refusal and source")
    return InstantResult(
        request_id=raw["request_id"],
        timestamp=None if raw["timestamp"] is None else int(raw["timestamp"]),
        status=status,
        source=source,
        pose=pose,
        refusal=refusal,
        images=tuple(_parse_image(image) for image in raw["images"]),
        correspondences=int(raw["correspondences"]),
        inliers=int(raw["inliers"]),
        inlier_ratio=float(raw["inlier_ratio"]),
        map=MapVersion(raw["map"]["id"], raw["map"]["version"]),
        seconds=_numbers_by_name(raw["seconds"]),
        raw=raw,
        # A server that does not know them leaves them out.
        geopose=parse_geopose(raw.get("geopose")),
        geopose_ypr=parse_geopose_ypr(raw.get("geopose_ypr")),
        tile=raw.get("tile"),
    )


def parse_maps(raw: JsonObject) -> list[MapInfo]:
    """Parse a ListMapsResponse."""
    return [parse_map(info) for info in raw["maps"]]


def parse_map(raw: JsonObject) -> MapInfo:
    """Parse a MapInfo."""
    return MapInfo(
        id=raw["id"],
        version=raw["version"],
        created=raw["created"],
        metric=bool(raw["metric"]),
        method=raw["method"] or None,
        local_features=raw["local_features"],
        global_features=tuple(raw["global_features"]),
        images=int(raw["images"]),
        landmarks=int(raw["landmarks"]),
        observations=None if raw["observations"] is None else int(raw["observations"]),
        extent=_parse_extent(raw["extent"]),
        size_bytes=int(raw["size_bytes"]),
        down=_numbers(raw["down"]) if raw["down"] else None,
        rigs=tuple(RigInfo(rig["id"], tuple(rig["sensors"])) for rig in raw["rigs"]),
        anchor=None if raw["anchor"] is None else _parse_anchor(raw["anchor"]),
        place=None if raw["place"] is None else GeoCircle(**_numbers_by_name(raw["place"])),
        current=bool(raw["current"]),
        versions=tuple(VersionInfo(v["version"], bool(v["current"])) for v in raw["versions"]),
        content_hash=raw["content_hash"],
        # A server that does not know them leaves them out.
        fusion=raw.get("fusion") or None,
        fusion_weights=_numbers_by_name(raw.get("fusion_weights") or {}),
        kind=raw.get("kind") or "map",
        num_tiles=None if raw.get("num_tiles") is None else int(raw["num_tiles"]),
        tiles=tuple(_parse_tile(tile) for tile in raw.get("tiles") or ()),
    )


def parse_server(raw: JsonObject) -> ServerInfo:
    """Parse what a server says of itself."""
    return ServerInfo(raw["version"])


def parse_ready(raw: JsonObject) -> bool:
    """Parse whether a server can answer now."""
    return bool(raw["ready"])


def _parse_extent(raw: JsonObject) -> tuple[tuple[float, ...], tuple[float, ...]]:
    return _numbers(raw["min"]), _numbers(raw["max"])


def _parse_tile(raw: JsonObject) -> TileInfo:
    set_from_tile = raw["set_from_tile"]
    return TileInfo(
        map=raw["map"],
        version=raw["version"],
        scale=float(set_from_tile["scale"]),
        rotation_wxyz=_numbers(set_from_tile["rotation_wxyz"]),
        translation=_numbers(set_from_tile["translation"]),
        extent=_parse_extent(raw["extent"]),
        images=int(raw["images"]),
    )


def _parse_debug(raw: JsonObject | None) -> Debug | None:
    if raw is None:  # not asked for, or a server that does not know it
        return None
    inliers = np.array(raw["inliers"], dtype=np.bool_)
    return Debug(
        keypoints=_array(raw["keypoints"], len(inliers), 2),
        points=_array(raw["points"], len(inliers), 3),
        inliers=inliers,
        overlay=base64.b64decode(raw["overlay"], validate=True),
    )


def _parse_anchor(raw: JsonObject) -> Anchor:
    geodetic = raw["geodetic"]
    return Anchor(
        raw["kind"],
        int(raw["images"]),
        None if raw["rms"] is None else float(raw["rms"]),
        None if geodetic is None else _parse_geodetic(geodetic),
    )


def _parse_geodetic(raw: JsonObject) -> Geodetic:
    return Geodetic(
        latitude_deg=float(raw["latitude_deg"]),
        longitude_deg=float(raw["longitude_deg"]),
        altitude_m=float(raw["altitude_m"]),
        scale=float(raw["scale"]),
        rotation_wxyz=_numbers(raw["rotation_wxyz"]),
        translation=_numbers(raw["translation"]),
    )


def _parse_rig_pose(raw: JsonObject) -> RigPose:
    rotation_wxyz, translation = _parse_transform(raw["rig_from_world"])
    return RigPose(
        Pose.from_quaternion(rotation_wxyz, translation),
        rotation_wxyz,
        translation,
        **_parse_uncertainty(raw),
    )


def _parse_image(raw: JsonObject) -> ImageResult:
    error, camera, orientation = raw["error"], raw["camera"], raw["orientation"]
    pose = raw["cam_from_world"]
    return ImageResult(
        sensor=raw["sensor"],
        error=None if error is None else received(error, INTERNAL, "the photo could not be used"),
        cam_from_world=None if pose is None else Pose.from_quaternion(*_parse_transform(pose)),
        keypoints=int(raw["keypoints"]),
        correspondences=int(raw["correspondences"]),
        inliers=int(raw["inliers"]),
        retrieved=_parse_retrieved(raw["retrieved"]),
        camera=None if camera is None else _parse_camera_used(camera),
        orientation=None if orientation is None else _parse_orientation(orientation),
    )


def _parse_transform(
    raw: JsonObject,
) -> tuple[tuple[float, float, float, float], tuple[float, float, float]]:
    w, x, y, z = _numbers(raw["rotation_wxyz"])
    tx, ty, tz = _numbers(raw["translation"])
    return (w, x, y, z), (tx, ty, tz)


def _parse_uncertainty(raw: JsonObject) -> dict[str, NDArray[np.float64]]:
    covariance = _array(raw["covariance"], 6, 6)
    if not np.isfinite(covariance).all():
        raise ValueError("a covariance that is not finite")
    least, *_, largest = np.linalg.eigvalsh(covariance)
    if least < -1e-9 * largest or not np.allclose(covariance, covariance.T, rtol=1e-6):
        raise ValueError("a covariance that is none")
    return {
        "position": _array(raw["position"], 3),
        "orientation": _array(raw["orientation"], 4),
        "covariance": covariance,
        "position_std": _array(raw["position_std"], 3),
        "orientation_std_deg": _array(raw["orientation_std_deg"], 3),
    }


def _parse_retrieved(raw: Sequence[JsonObject]) -> tuple[RetrievedImage, ...]:
    return tuple(
        RetrievedImage(
            image["image"], float(image["score"]), _numbers_by_name(image["similarities"])
        )
        for image in raw
    )


def _parse_camera_used(raw: JsonObject) -> CameraUsed:
    return CameraUsed(_parse_camera(raw), raw["source"])


def _parse_orientation(raw: JsonObject) -> Orientation:
    return Orientation(int(raw["exif"]), raw["read_as"])


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
