"""What is known of a pose beforehand (``visloc.priors``), as the API has it in JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import NDArray

from visloc.errors import InvalidInput, VislocError, refuse
from visloc.geometry import Pose
from visloc.priors import (
    GravityPrior,
    HeightBand,
    PosePrior,
    PositionPrior,
    Priors,
    check_covariance,
)

_DEFAULT_GRAVITY_STD_DEG = 1.0  # the server's
_MAX_LENGTH_ERROR = 1e-3  # of a unit quaternion
_FIELDS: Mapping[str, tuple[str, ...]] = {
    "position": ("position", "radius"),
    "height": ("min", "max"),
    "pose": ("device_from_world", "covariance"),
    "gravity": ("direction", "std_deg", "world"),
}


def priors_as_json(priors: Priors) -> dict[str, Any]:
    """Return what is known, without what is not."""
    given: dict[str, Any] = {}
    if priors.position is not None:
        position, radius = priors.position.position, priors.position.radius
        given["position"] = {"position": position.tolist(), "radius": radius}
    if priors.height is not None:
        if priors.height.down is not None:
            raise refuse("priors.height", field="priors.height")
        given["height"] = {"min": priors.height.min, "max": priors.height.max}
    if priors.pose is not None:
        given["pose"] = {
            "device_from_world": transform_as_json(priors.pose.device_from_world),
            "covariance": priors.pose.covariance.ravel().tolist(),
        }
    if priors.gravity is not None:
        gravity = {
            "direction": priors.gravity.direction.tolist(),
            "std_deg": math.degrees(priors.gravity.std),
        }
        if priors.gravity.world is not None:
            gravity["world"] = priors.gravity.world.tolist()
        given["gravity"] = gravity
    if priors.maps is not None:
        given["maps"] = list(priors.maps)
    return given


def transform_as_json(pose: Pose) -> dict[str, Any]:
    """Return a transform as the API has it."""
    return {
        "rotation_wxyz": pose.rotation_wxyz.tolist(),
        "translation": pose.translation.tolist(),
    }


def priors_from_text(text: str) -> Priors:
    """Parse priors as the command line has them: JSON, or the path of a file that holds it.

    Raises:
        InvalidInput: ``priors.unreadable`` for neither, and as ``priors_from_json``.
    """
    try:
        raw = json.loads(text if text.lstrip().startswith("{") else Path(text).read_bytes())
    except (OSError, ValueError) as error:
        raise refuse("priors.unreadable", field="priors", got=f"{text[:80]} ({error})") from error
    return priors_from_json(raw)


def priors_from_json(raw: object) -> Priors:
    """Make priors of the API's JSON; null is the same as left out.

    Raises:
        InvalidInput: ``request.unknown_field``, ``request.invalid``, ``priors.position``,
            ``priors.height``, ``priors.pose``, ``priors.gravity``, ``priors.maps``, or ``pose.*``.
    """
    given = _given("priors", raw, (*_FIELDS, "maps"))
    parts = {
        name: _given(f"priors.{name}", given[name], fields)
        for name, fields in _FIELDS.items()
        if name in given
    }
    position, height, pose, gravity = (parts.get(name) for name in _FIELDS)
    return Priors(
        None
        if position is None
        else PositionPrior(
            _numbers("position.position", position), _number("position.radius", position)
        ),
        None
        if height is None
        else HeightBand(_number("height.min", height), _number("height.max", height)),
        None if pose is None else _pose_prior(pose),
        None if gravity is None else _gravity_prior(gravity),
        None if "maps" not in given else _tiles(given["maps"]),
    )


def checked_covariance(given: object, field: str) -> NDArray[np.float64]:
    """Return the covariance (6, 6) of a pose.

    Raises:
        InvalidInput: ``pose.covariance``, with the shape that came where that is wrong.
    """
    try:
        covariance = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        covariance, got = np.empty(0), given
    else:
        got = covariance.tolist()
        if covariance.shape != (6, 6):
            got = f"{covariance.size} numbers, of shape {covariance.shape}"
    try:
        check_covariance(covariance, field)
    except InvalidInput as error:
        raise refuse(error.code, field=error.field, expected=error.expected, got=got) from None
    return covariance


def _pose_prior(raw: Mapping[str, Any]) -> PosePrior:
    where = "pose.device_from_world"
    transform = _given(
        f"priors.{where}", raw.get("device_from_world"), ("rotation_wxyz", "translation")
    )
    rotation_wxyz = _numbers(f"{where}.rotation_wxyz", transform)
    if not abs(math.hypot(*rotation_wxyz) - 1.0) <= _MAX_LENGTH_ERROR:
        raise refuse(
            "pose.rotation",
            "the quaternion of the rotation does not have length 1",
            field=f"priors.{where}.rotation_wxyz",
            expected="a unit quaternion w, x, y, z",
            got=rotation_wxyz.tolist(),
        )
    pose = Pose.from_quaternion(rotation_wxyz, _numbers(f"{where}.translation", transform))
    numbers = _numbers("pose.covariance", raw)
    covariance = numbers.reshape(6, 6) if numbers.size == 36 else numbers
    return PosePrior(pose, checked_covariance(covariance, "priors.pose.covariance"))


def _gravity_prior(raw: Mapping[str, Any]) -> GravityPrior:
    std_deg = _number("gravity.std_deg", raw) if "std_deg" in raw else _DEFAULT_GRAVITY_STD_DEG
    world = _numbers("gravity.world", raw) if "world" in raw else None
    return GravityPrior(_numbers("gravity.direction", raw), math.radians(std_deg), world)


def _tiles(names: object) -> tuple[str, ...]:
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise _unusable("maps", "a list of maps of the set", names)
    return tuple(names)


def _given(where: str, raw: object, fields: tuple[str, ...]) -> dict[str, Any]:
    """Return the fields of an object that are not null."""
    if not isinstance(raw, dict):
        raise refuse(
            "request.invalid",
            "the value is not an object",
            field=where,
            expected=f"an object with {', '.join(fields)}",
            got=raw,
        )
    for name in raw:
        if name not in fields:
            raise refuse(
                "request.unknown_field", field=f"{where}.{name}", expected=fields, got=name
            )
    return {name: value for name, value in raw.items() if value is not None}


def _number(path: str, raw: Mapping[str, Any]) -> float:
    value = raw.get(path.rpartition(".")[2])
    if not _is_number(value):
        raise _unusable(path, "a number", value)
    return float(value)


def _numbers(path: str, raw: Mapping[str, Any]) -> NDArray[np.float64]:
    values = raw.get(path.rpartition(".")[2])
    if not isinstance(values, list) or not all(map(_is_number, values)):
        raise _unusable(path, "a list of numbers", values)
    return np.array(values, dtype=np.float64)


def _is_number(value: object) -> TypeGuard[float]:
    # Whole numbers in JSON can be larger than any float.
    return isinstance(value, float) or (type(value) is int and abs(value) < 2**1000)


def _unusable(path: str, expected: str, got: object) -> VislocError:
    return refuse(
        f"priors.{path.partition('.')[0]}", field=f"priors.{path}", expected=expected, got=got
    )
