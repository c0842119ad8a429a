"""Cameras, transforms, and the poses of answers: where it was, and how sure that is."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BeforeValidator, Field, model_validator
from pydantic.json_schema import WithJsonSchema

import visloc.geometry
import visloc.priors
import visloc.types
from visloc.errors import InvalidInput, refuse
from visloc.geometry import Pose
from visloc_api.words.base import (
    AnswerWithArrays,
    Covariance,
    Numbers3,
    Numbers4,
    OneOf,
    OptionalCovariance,
    SentAs,
)
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
        """Say a pose that nobody has checked yet."""
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
        """Return the transform, checked."""
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
    """Return the checked covariance (6, 6) of a pose."""
    covariance = np.array(numbers, dtype=np.float64)
    if covariance.shape == (36,):
        covariance = covariance.reshape(6, 6)
    visloc.priors.check_covariance(covariance, field)
    return covariance


def covariance_from_core(covariance: ArrayLike, field: str) -> list[float]:
    """Say the covariance (6, 6) of a pose that nobody has checked yet."""
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


# Appended to the description of every stated uncertainty.
_COVERED = (
    "; the whole, with the errors that landmarks of the map share, where uncertainty says so; else "
    "from the scatter of the matches only"
)
_COVARIANCE = (
    "6 x 6, row by row: rotation (rad), then translation, for R <- Exp(w) R and t <- t + dt of "
)
_ABOUT = "standard deviations about the {}'s x, y and z axes, degrees"
# Of a pose. Older services do not state it.
_PROBABILITY = (
    "that the pose is right, 0 to 1, judged by what the photo shows of all that the map has there; "
)


def _stated(description: str) -> Any:
    """Describe a field with an uncertainty, and what it covers."""
    return Field(description=description + _COVERED)


_PositionStd = Annotated[
    Numbers3, _stated("standard deviations of the position along the world's axes")
]


_PHOTO_PART = (
    "6 x 6, the part of covariance that the scatter of the matches alone leaves open; "
    "empty for a pose that no image of its own measured"
)
_UNCERTAINTY = (
    "whole: covariance holds the errors of the photo and of the map, as the map's own test found "
    "them; photo only: the map has no such test"
)


def _uncertainty(value: Any) -> Any:
    """An older service states what the photo tells, and no word for it."""
    return value or visloc.types.Uncertainty.PHOTO_ONLY


_Uncertainty = Annotated[
    str,
    OneOf(visloc.types.Uncertainty),
    BeforeValidator(_uncertainty),
    Field(description=_UNCERTAINTY),
]
_PhotoCovariance = Annotated[OptionalCovariance, Field(description=_PHOTO_PART)]
_Metric = Annotated[
    bool | None,
    Field(
        description="whether the unit of position and translation is the metre; false: its length "
        "is unknown; null: an older service, which does not say"
    ),
]


class _ReceivedPose(Pose):
    """A pose, and the numbers that were sent of it, which a rotation matrix rounds."""

    __slots__ = ("sent",)
    sent: Transform

    @staticmethod
    def read(raw: Any) -> _ReceivedPose:
        """Read JSON."""
        rotation_wxyz, translation = (
            [float(number) for number in raw[name]] for name in ("rotation_wxyz", "translation")
        )
        pose = Pose.from_quaternion(rotation_wxyz, translation)
        received = _ReceivedPose(pose.rotation, pose.translation)
        sent = Transform(rotation_wxyz=rotation_wxyz, translation=translation)
        object.__setattr__(received, "sent", sent)
        return received


def _transform(pose: Pose) -> Transform:
    return pose.sent if isinstance(pose, _ReceivedPose) else Transform.from_core(pose)


SentPose = Annotated[Pose, SentAs(Transform, Pose, _ReceivedPose.read, _transform)]


class _PoseWithDigits(AnswerWithArrays):
    """A pose whose numbers can be had with every digit as sent."""

    pose_field: ClassVar[str]

    @model_validator(mode="before")
    @classmethod
    def _from_digits(cls, values: Any) -> Any:
        if isinstance(values, Mapping) and "rotation_wxyz" in values:
            values = {**values, cls.pose_field: values}
        return values

    @property
    def rotation_wxyz(self) -> tuple[float, float, float, float]:
        """The rotation as a unit quaternion (w, x, y, z)."""
        w, x, y, z = _transform(getattr(self, self.pose_field)).rotation_wxyz
        return w, x, y, z

    @property
    def translation(self) -> tuple[float, float, float]:
        """The translation, metres when the map is metric."""
        x, y, z = _transform(getattr(self, self.pose_field)).translation
        return x, y, z


class PoseEstimate(_PoseWithDigits):
    """Where the photo was taken, and how sure that is."""

    pose_field = "cam_from_world"

    cam_from_world: SentPose
    position: Annotated[
        Numbers3,
        Field(description="camera centre in the world, metres when the map is metric"),
    ]
    orientation: Annotated[Numbers4, Field(description="rotation of world_from_cam as w, x, y, z")]
    covariance: Annotated[Covariance, _stated(f"{_COVARIANCE}cam_from_world")]
    position_std: _PositionStd
    orientation_std_deg: Annotated[Numbers3, _stated(_ABOUT.format("camera"))]
    photo_covariance: _PhotoCovariance = None
    uncertainty: _Uncertainty = visloc.types.Uncertainty.PHOTO_ONLY
    probability: Annotated[
        float | None, Field(ge=0, le=1, description=f"{_PROBABILITY}null when it was not judged")
    ] = None
    metric: _Metric = None


class CoarsePose(_PoseWithDigits):
    """Where the most similar mapping photos say that the photo was taken; nothing confirms it."""

    pose_field = "cam_from_world"

    cam_from_world: SentPose
    position: Annotated[
        Numbers3,
        Field(description="camera centre in the world, metres when the map is metric"),
    ]
    orientation: Annotated[Numbers4, Field(description="rotation of world_from_cam as w, x, y, z")]
    covariance: Annotated[
        Covariance,
        Field(
            description=f"{_COVARIANCE}cam_from_world; learned from the map's own photos, so that "
            "the ellipsoid of 95 % holds for photos of this place"
        ),
    ]
    position_std: Annotated[
        Numbers3, Field(description="standard deviations of the position along the world's axes")
    ]
    orientation_std_deg: Annotated[Numbers3, Field(description=_ABOUT.format("camera"))]
    method: Annotated[
        str,
        OneOf(visloc.types.CoarseMethod),
        Field(
            description="bdi: interpolated as their global descriptors make up the photo's; "
            "ewb: their mean; csi: their mean weighted by similarity"
        ),
    ]
    metric: _Metric = None


class RigPose(_PoseWithDigits):
    """Where the rig was, and how sure that is."""

    pose_field = "rig_from_world"

    rig_from_world: SentPose
    position: Annotated[
        Numbers3,
        Field(description="the rig's origin in the world, metres when the map is metric"),
    ]
    orientation: Annotated[Numbers4, Field(description="rotation of world_from_rig as w, x, y, z")]
    covariance: Annotated[Covariance, _stated(f"{_COVARIANCE}rig_from_world")]
    position_std: _PositionStd
    orientation_std_deg: Annotated[Numbers3, _stated(_ABOUT.format("rig"))]
    photo_covariance: _PhotoCovariance = None
    uncertainty: _Uncertainty = visloc.types.Uncertainty.PHOTO_ONLY
    probability: Annotated[
        float | None,
        Field(
            ge=0,
            le=1,
            description=f"{_PROBABILITY}null when the instant's own images did not measure it, or "
            "only with the help of other instants",
        ),
    ] = None
    metric: _Metric = None
