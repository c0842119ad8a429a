"""The answers to a photo, to the images of a rig, and to the instants of a sequence."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

import visloc.options
import visloc.types
from visloc.geometry import Camera, Pose
from visloc.types import PoseSource
from visloc_api.words.base import (
    Answer,
    AnswerWithArrays,
    Base64,
    Covariance,
    Flags,
    Numbers3,
    Numbers4,
    NumbersNx2,
    NumbersNx3,
    OneOf,
    OptionalCovariance,
    SentAs,
)
from visloc_api.words.geometry import Transform
from visloc_api.words.geopose import GeoPose, GeoPoseYpr

# A sequence has thousands of images, and each may have been matched against a thousand photos.
MAX_RETRIEVED = 20
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


class MapRef(Answer):
    """The map that answered, or the set of maps."""

    id: str
    version: str


class Candidate(AnswerWithArrays):
    """One of the two places between which an ambiguous query leaves the choice."""

    map: Annotated[
        MapRef, Field(description="the map, or the set of maps, in whose frame the pose is")
    ]
    tile: Annotated[
        str | None, Field(description="of a set: id@version of the map in it; null otherwise")
    ] = None
    position: Annotated[
        Numbers3,
        Field(description="camera centre, or the rig's origin, in the world"),
    ]
    orientation: Annotated[
        Numbers4,
        Field(description="rotation of world_from_cam, or of world_from_rig, as w, x, y, z"),
    ]
    inliers: Annotated[int, Field(description="keypoints that agree with the pose")]
    image: Annotated[
        str | None, Field(description="the mapping photo that speaks most for this place")
    ] = None
    preference: Annotated[
        float | None,
        Field(
            description="how surely the keypoints speak for this place and against the other one, "
            "in standard deviations; null when they were not compared"
        ),
    ] = None


class Refusal(Answer):
    """Why there is no pose."""

    stage: Annotated[str, OneOf(visloc.types.Stage), Field(description="the stage that refused")]
    reason: Annotated[str, OneOf(visloc.types.Reason), Field(description="a stable word")]
    message: Annotated[str, Field(description="for a person")]
    candidates: Annotated[
        tuple[Candidate, ...],
        Field(
            description="of reason ambiguous: the places with a pose, most inliers first; "
            "empty otherwise"
        ),
    ] = ()


class RetrievedImage(Answer):
    """A mapping photo that was matched against."""

    image: Annotated[str, Field(description="its name in the map")]
    score: Annotated[
        float, Field(description="fused similarity; comparable only within one answer")
    ]
    similarities: Annotated[dict[str, float], Field(description="cosine by global descriptor")]


class CameraUsed(Answer):
    """The intrinsics used, for the pixels as stored."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]
    source: Annotated[
        str,
        OneOf(visloc.types.CameraSource),
        Field(
            description="given: as sent; given_scaled: as sent, for another size of the same "
            "aspect; exif: focal length from EXIF; estimated: focal length solved with "
            "the pose; guess: focal length 1.2 times the longer side"
        ),
    ]

    @model_validator(mode="before")
    @classmethod
    def _from_camera(cls, values: Any) -> Any:
        if isinstance(values, Mapping) and isinstance(camera := values.get("camera"), Camera):
            names = ("model", "width", "height", "params")
            values = {**values, **{name: getattr(camera, name) for name in names}}
        return values

    @model_validator(mode="after")
    def _check_camera(self) -> Self:
        self.camera  # noqa: B018  raises InvalidInput
        return self

    @property
    def camera(self) -> Camera:
        """The intrinsics as a ``Camera``."""
        return Camera(self.model, self.width, self.height, self.params)


class Orientation(Answer):
    """How the photo was rotated before features were found.

    Camera, keypoints and pose always refer to the stored pixels.
    """

    exif: Annotated[int, Field(description="1 to 8 as stored in the photo, 1 when absent")]
    read_as: Annotated[
        str,
        OneOf(visloc.options.ReadAs),
        Field(
            description="upright: features were found in the photo turned by its EXIF orientation; "
            "stored: in the pixels as stored, or the features were sent"
        ),
    ]
    turned: Annotated[
        int,
        Field(
            description="degrees clockwise, 0 to 315, by which the photo was turned beyond that, "
            "because the map knew it only so"
        ),
    ] = 0


# In Python, keypoints are (n, 2), points (n, 3) and inliers (n,).
class Debug(AnswerWithArrays):
    """The solver's input, correspondence by correspondence, and its result."""

    keypoints: Annotated[
        NumbersNx2,
        Field(description="x, y of each, in one flat list, in pixels of the photo as stored"),
    ]
    points: Annotated[
        NumbersNx3, Field(description="x, y, z of each in the world, in one flat list")
    ]
    inliers: Annotated[
        Flags,
        Field(
            description="of each: whether the best pose explains it, even if that pose was refused"
        ),
    ]
    overlay: Annotated[
        Base64,
        Field(
            description="JPEG: the photo and its matches, beside the mapping photos that it was "
            "matched with"
        ),
    ]

    @model_validator(mode="after")
    def _check_lengths(self) -> Self:
        if not len(self.keypoints) == len(self.points) == len(self.inliers):
            raise ValueError("correspondences that are not whole")
        return self


# Of a set, the map in it that answered.
_TileRef = Annotated[
    str | None,
    Field(
        description="for a set: id@version of the tile that gave the answer, or came closest; "
        "null for a map on its own"
    ),
]
_RequestId = Annotated[str, Field(description="sent by the caller, or made by the server")]
_Inliers = Annotated[
    int, Field(description="correspondences that agree with the best pose, even if it was refused")
]
_InlierRatio = Annotated[float, Field(description="inliers / correspondences; 0 without any")]
_Ypr = Annotated[GeoPoseYpr | None, Field(description="the GeoPose in angles, when asked for")]


class LocalizeResponse(AnswerWithArrays):
    """The answer: a pose, or the reason why there is none."""

    request_id: _RequestId
    status: Literal["localized", "not_localized"]
    pose: Annotated[PoseEstimate | None, Field(description="null when not localized")]
    refusal: Annotated[Refusal | None, Field(description="null when localized")]
    keypoints: Annotated[int, Field(description="found in the photo")]
    correspondences: Annotated[int, Field(description="2D-3D matches given to the solver")]
    inliers: _Inliers
    inlier_ratio: _InlierRatio
    retrieved: Annotated[
        tuple[RetrievedImage, ...],
        Field(description="mapping photos matched against, best first"),
    ]
    camera: CameraUsed
    orientation: Orientation
    map: MapRef
    seconds: Annotated[dict[str, float], Field(description="wall time by stage that was reached")]
    geopose: Annotated[
        GeoPose | None,
        Field(
            description="of the camera; null when not localized, or when the map is not anchored"
        ),
    ] = None
    geopose_ypr: _Ypr = None
    debug: Annotated[Debug | None, Field(description="the matches, when asked for")] = None
    tile: _TileRef = None

    @model_validator(mode="after")
    def _check_status(self) -> Self:
        if (self.status, self.pose is None, self.refusal is None) not in (
            ("localized", False, True),
            ("not_localized", True, False),
        ):
            raise ValueError(f"status {self.status!r} does not fit pose and refusal")
        return self

    @property
    def localized(self) -> bool:
        """Whether there is a pose."""
        return self.pose is not None


class ImageError(Answer):
    """Why an image could not be used."""

    kind: Annotated[str, Field(description="the kind of error, such as InvalidInput")]
    code: Annotated[str, Field(description="a stable word, such as image.undecodable")]
    message: Annotated[str, Field(description="for a person")]


class ImageAnswer(AnswerWithArrays):
    """What one image of an instant contributed."""

    sensor: str
    error: Annotated[
        ImageError | None,
        Field(description="why it could not be used; the others are answered without it"),
    ]
    cam_from_world: Annotated[
        SentPose | None,
        Field(
            description="null when the instant has no pose; given even if the image could not be "
            "used"
        ),
    ]
    keypoints: Annotated[int, Field(description="found in the photo")]
    correspondences: Annotated[int, Field(description="2D-3D matches given to the solver")]
    inliers: Annotated[int, Field(description="correspondences that agree with the rig's pose")]
    retrieved: Annotated[
        tuple[RetrievedImage, ...],
        Field(description=f"the best {MAX_RETRIEVED} mapping photos matched against, best first"),
    ]
    camera: Annotated[CameraUsed | None, Field(description="null when there is an error")]
    orientation: Annotated[Orientation | None, Field(description="null when there is an error")]


class InstantAnswer(AnswerWithArrays):
    """The answer to an instant: a pose and its source, or the reason why there is none."""

    request_id: _RequestId
    timestamp: Annotated[int | None, Field(description="as it was sent")]
    status: Annotated[
        Literal["localized", "filled", "not_localized"],
        Field(description="filled: the pose comes from other instants"),
    ]
    source: Annotated[
        PoseSource | None,
        Field(
            description="estimated: from the instant's own images; motion, interpolated, nearest: "
            "filled from other instants; null without a pose"
        ),
    ]
    pose: Annotated[RigPose | None, Field(description="null when not localized")]
    refusal: Annotated[
        Refusal | None, Field(description="why the instant's own images gave no pose")
    ]
    images: Annotated[tuple[ImageAnswer, ...], Field(description="in the order of the request")]
    correspondences: Annotated[int, Field(description="of all images")]
    inliers: _Inliers
    inlier_ratio: _InlierRatio
    map: MapRef
    seconds: Annotated[
        dict[str, float],
        Field(description="wall time by stage that was reached, summed over the images"),
    ]
    geopose: Annotated[
        GeoPose | None,
        Field(
            description="of the rig, with the axes of its frame read like a camera's; null without "
            "a pose, or when the map is not anchored"
        ),
    ] = None
    geopose_ypr: _Ypr = None
    tile: _TileRef = None

    @model_validator(mode="after")
    def _check_status(self) -> Self:
        source = self.source
        has = (self.pose is not None, self.refusal is not None, source is not None)
        if (self.status, *has, source is PoseSource.ESTIMATED) not in (
            ("localized", True, False, True, True),
            ("filled", True, True, True, False),
            ("not_localized", False, True, False, False),
        ):
            raise ValueError(f"status {self.status!r} does not fit pose, refusal and source")
        return self

    @property
    def localized(self) -> bool:
        """Whether the instant's own photos gave the pose; False when it was filled."""
        return self.status == "localized"


class LocalizeSequenceResponse(Answer):
    """The answers to a sequence."""

    request_id: _RequestId
    answers: Annotated[tuple[InstantAnswer, ...], Field(description="one per instant, in order")]
