"""The poses of answers: where a photo was taken, or a rig was, and how sure that is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

from pydantic import BeforeValidator, Field, model_validator

import visloc.types
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
from visloc_api.words.geometry import Transform

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
