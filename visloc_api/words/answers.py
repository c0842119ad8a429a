"""The answers to a photo, to the images of a rig, and to the instants of a sequence."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

import visloc.options
import visloc.types
from visloc.geometry import Camera
from visloc.types import PoseSource
from visloc_api.words.base import (
    Answer,
    AnswerWithArrays,
    Base64,
    Flags,
    Numbers3,
    Numbers4,
    NumbersNx2,
    NumbersNx3,
    OneOf,
)
from visloc_api.words.geopose import GeoPose, GeoPoseYpr
from visloc_api.words.poses import CoarsePose, PoseEstimate, RigPose, SentPose

# A sequence has thousands of images, and each may have been matched against a thousand photos.
MAX_RETRIEVED = 20


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
            "aspect; map: of the map's photos by the same camera; exif: focal length from EXIF; "
            "estimated: focal length solved with the pose; guess: focal length 1.2 times the "
            "longer side. In all but the last, with what the photo showed to be off corrected"
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
    status: Annotated[
        Literal["localized", "coarse", "not_localized"],
        Field(description="coarse: not localized, but there is a coarse pose"),
    ]
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
    coarse: Annotated[
        CoarsePose | None,
        Field(description="of status coarse: the pose that options.fallback asked for; else null"),
    ] = None

    @model_validator(mode="after")
    def _check_status(self) -> Self:
        has = (self.pose is not None, self.refusal is not None, self.coarse is not None)
        if (self.status, *has) not in (
            ("localized", True, False, False),
            ("coarse", False, True, True),
            ("not_localized", False, True, False),
        ):
            raise ValueError(f"status {self.status!r} does not fit pose and refusal")
        return self

    @property
    def localized(self) -> bool:
        """Whether there is a pose; False with a coarse one only."""
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
