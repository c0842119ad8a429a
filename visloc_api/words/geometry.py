"""Cameras and transforms, in requests and answers."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field
from pydantic.json_schema import WithJsonSchema

import visloc.geometry
import visloc.priors
from visloc.errors import InvalidInput, refuse
from visloc_api.words.message import IncomingMessage, converted

_CAMERA_TEXT = "PINHOLE,640,480,525,525,320,240"
# How far the length of a quaternion may be from 1: it was written with three digits at least.
_MAX_QUATERNION_ERROR = 1e-3
# The same of a matrix times its transpose.
_MAX_SCALE_ERROR = 1e-3
# Further than any place; its square is still a number.
_MAX_TRANSLATION = 1e15

# One complaint is enough of a list with a million of them.
Numbers = Annotated[list[float], Field(fail_fast=True)]


class Camera(IncomingMessage):
    """Intrinsics for the pixels as stored."""

    path: ClassVar[str] = "camera."

    model: Annotated[str, Field(description="COLMAP's name, such as PINHOLE")]
    width: Annotated[int, Field(description="pixels")]
    height: Annotated[int, Field(description="pixels")]
    params: Annotated[
        Numbers, Field(description="in COLMAP's order, pixels where they are lengths")
    ]

    def to_core(self) -> visloc.geometry.Camera:
        """Return the camera, checked."""
        return visloc.geometry.Camera(self.model, self.width, self.height, tuple(self.params))

    @staticmethod
    def from_core(camera: visloc.geometry.Camera) -> Camera:
        return Camera(
            model=camera.model,
            width=camera.width,
            height=camera.height,
            params=list(camera.params),
        )


def _camera_from_text(value: object) -> object:
    if not isinstance(value, str):
        return value
    if value.lstrip().startswith("{"):
        return Camera.read_json(value)
    return Camera.from_core(visloc.geometry.Camera.from_text(value))


# A camera in any of the forms that it may be sent in.
GivenCamera = Annotated[
    Camera | None,
    converted(_camera_from_text),
    WithJsonSchema(
        {
            "anyOf": [
                {"$ref": "#/components/schemas/Camera"},
                {"type": "string", "examples": [_CAMERA_TEXT]},
                {"type": "null"},
            ]
        }
    ),
]


class Transform(IncomingMessage):
    """x_a = R x_b + t for a transform called a_from_b."""

    rotation_wxyz: Annotated[Numbers, Field(description="unit quaternion, w >= 0")]
    translation: Annotated[Numbers, Field(description="metres when the map is metric")]

    @staticmethod
    def from_core(pose: visloc.geometry.Pose) -> Transform:
        return Transform(
            rotation_wxyz=pose.rotation_wxyz.tolist(), translation=pose.translation.tolist()
        )

    @staticmethod
    def checked(
        pose: visloc.geometry.Pose, field: str, rotation_code: str = "pose.rotation"
    ) -> Transform:
        """Say a pose that nobody has checked yet.

        Raises:
            InvalidInput: as ``to_core``; for a matrix with a scale too, which the quaternion hides.
        """
        error = np.abs(pose.rotation @ pose.rotation.T - np.eye(3)).max()
        if not (error <= _MAX_SCALE_ERROR and np.linalg.det(pose.rotation) > 0):  # NaN fails too
            raise refuse(
                rotation_code,
                "the rotation is scaled, sheared or mirrored",
                field=field,
                expected="a rotation matrix",
                got=pose.rotation.tolist(),
            )
        transform = Transform.from_core(pose)
        transform.to_core(field, rotation_code)
        return transform

    def to_core(self, field: str, rotation_code: str = "pose.rotation") -> visloc.geometry.Pose:
        """Return the transform, checked.

        Args:
            field: its name, for errors.
            rotation_code: the code of an error of its rotation.

        Raises:
            InvalidInput: ``rotation_code`` unless the quaternion has length 1 within 1e-3, which a
                transform with a scale has not; ``pose.translation`` unless it is three finite
                numbers within reach.
        """
        length = math.hypot(*self.rotation_wxyz)
        # NaN fails too.
        if len(self.rotation_wxyz) != 4 or not abs(length - 1) <= _MAX_QUATERNION_ERROR:
            raise refuse(
                rotation_code,
                "the rotation is not valid; a transform with a scale cannot be used",
                field=f"{field}.rotation_wxyz",
                expected=f"a quaternion w, x, y, z of length 1 within {_MAX_QUATERNION_ERROR}",
                got=f"length {length:.6g}"
                if len(self.rotation_wxyz) == 4
                else f"{len(self.rotation_wxyz)} numbers",
            )
        far = [number for number in self.translation if not abs(number) <= _MAX_TRANSLATION]
        if len(self.translation) != 3 or far:  # NaN is far too
            raise refuse(
                "pose.translation",
                field=f"{field}.translation",
                expected=f"three finite numbers, none beyond {_MAX_TRANSLATION:g}",
                got=str(self.translation[:4]),
            )
        return visloc.geometry.Pose.from_quaternion(self.rotation_wxyz, self.translation)


def covariance_to_core(numbers: list[float], field: str) -> NDArray[np.float64]:
    """Return the checked covariance (6, 6) of a pose.

    Raises:
        InvalidInput: ``pose.covariance``.
    """
    covariance = np.array(numbers, dtype=np.float64)
    if covariance.shape == (36,):
        covariance = covariance.reshape(6, 6)
    visloc.priors.check_covariance(covariance, field)
    return covariance


def covariance_from_core(covariance: ArrayLike, field: str) -> list[float]:
    """Say the covariance (6, 6) of a pose that nobody has checked yet.

    Raises:
        InvalidInput: ``pose.covariance``, with the shape that came where that is wrong.
    """
    try:
        array = np.asarray(covariance, dtype=np.float64)
        visloc.priors.check_covariance(array, field)
    except (TypeError, ValueError):  # no numbers, or rows of different lengths
        raise refuse("pose.covariance", field=field, got=covariance) from None
    except InvalidInput as error:
        is_6_by_6 = array.shape == (6, 6)
        got = array.tolist() if is_6_by_6 else f"{array.size} numbers, of shape {array.shape}"
        raise refuse(error.code, field=field, expected=error.expected, got=got) from None
    numbers: list[float] = array.ravel().tolist()
    return numbers
