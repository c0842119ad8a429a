"""The answers to the instants of a rig or a sequence."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, Field

import visloc.types
from service.api.evidence import (
    NOT_COVERED,
    CameraUsed,
    MapRef,
    Orientation,
    Refusal,
    RetrievedImage,
    TileRef,
)
from service.api.geometry import Transform
from service.api.geopose import GeoPose, GeoPoseYpr, geoposes_to_words
from service.values import Localization
from visloc.errors import VislocError
from visloc.sequences.filling import PoseSource

# A sequence has thousands of images, and each may have been matched against a thousand photos.
MAX_RETRIEVED = 20


class RigPose(BaseModel):
    """Where the rig was, and how sure that is."""

    rig_from_world: Transform
    position: Annotated[
        list[float],
        Field(description="the rig's origin in the world, metres when the map is metric"),
    ]
    orientation: Annotated[
        list[float], Field(description="rotation of world_from_rig as w, x, y, z")
    ]
    covariance: Annotated[
        list[float],
        Field(
            description="6 x 6, row by row: rotation (rad), then translation, for "
            "R <- Exp(w) R and t <- t + dt of rig_from_world" + NOT_COVERED
        ),
    ]
    position_std: Annotated[
        list[float],
        Field(
            description="standard deviations of the position along the world's axes" + NOT_COVERED
        ),
    ]
    orientation_std_deg: Annotated[
        list[float],
        Field(
            description="standard deviations about the rig's x, y and z axes, degrees" + NOT_COVERED
        ),
    ]


class ImageError(BaseModel):
    """Why an image could not be used."""

    kind: Annotated[str, Field(description="the kind of error, such as InvalidInput")]
    code: Annotated[str, Field(description="a stable word, such as image.undecodable")]
    message: Annotated[str, Field(description="for a person")]

    @staticmethod
    def of(error: VislocError) -> ImageError:
        """Say it in the API's words."""
        return ImageError(kind=type(error).__name__, code=error.code, message=str(error))


class ImageAnswer(BaseModel):
    """What one image of an instant contributed."""

    sensor: str
    error: Annotated[
        ImageError | None,
        Field(description="why it could not be used; the others are answered without it"),
    ]
    cam_from_world: Annotated[
        Transform | None,
        Field(description="when the instant has a pose, also of an image that could not be used"),
    ]
    keypoints: Annotated[int, Field(description="found in the photo")]
    correspondences: Annotated[int, Field(description="2D-3D matches given to the solver")]
    inliers: Annotated[int, Field(description="of them, those that agree with the rig's pose")]
    retrieved: Annotated[
        list[RetrievedImage],
        Field(description=f"the best {MAX_RETRIEVED} mapping photos matched against, best first"),
    ]
    camera: Annotated[CameraUsed | None, Field(description="null when there is an error")]
    orientation: Annotated[Orientation | None, Field(description="null when there is an error")]


class InstantAnswer(BaseModel):
    """The answer to an instant: a pose and what it rests on, or the reason why there is none."""

    request_id: Annotated[str, Field(description="the caller's, or made by the server")]
    timestamp: Annotated[int | None, Field(description="as it was sent")]
    status: Annotated[
        Literal["localized", "filled", "not_localized"],
        Field(description="filled: the pose rests on other instants"),
    ]
    source: Annotated[
        PoseSource | None,
        Field(
            description="estimated, from the instant's own images; motion, interpolated or "
            "nearest when filled; null without a pose"
        ),
    ]
    pose: Annotated[RigPose | None, Field(description="null when not localized")]
    refusal: Annotated[
        Refusal | None, Field(description="why the instant's own images gave no pose")
    ]
    images: Annotated[list[ImageAnswer], Field(description="in the order of the request")]
    correspondences: Annotated[int, Field(description="of all images")]
    inliers: Annotated[
        int, Field(description="of them, those that agree with the best pose, refused or not")
    ]
    inlier_ratio: Annotated[float, Field(description="inliers / correspondences; 0 without any")]
    map: MapRef
    seconds: Annotated[
        dict[str, float],
        Field(description="wall time by stage that was reached, summed over the images"),
    ]
    geopose: Annotated[
        GeoPose | None,
        Field(
            description="of the rig, whose frame is read like a camera's; null without a pose, or "
            "when the map is not anchored"
        ),
    ] = None
    geopose_ypr: Annotated[
        GeoPoseYpr | None, Field(description="the same in angles, when asked for")
    ] = None
    tile: TileRef = None

    @staticmethod
    def from_localization(found: Localization, request_id: str) -> InstantAnswer:
        """Say it in the API's words."""
        answer = found.answer
        pose, correspondences = answer.pose, answer.num_correspondences
        geopose, geopose_ypr = geoposes_to_words(
            None if pose is None else pose.rig_from_world, found.geodetic, ypr=found.ypr
        )
        return InstantAnswer(
            request_id=request_id,
            timestamp=answer.timestamp,
            status="not_localized"
            if pose is None
            else "localized"
            if pose.source is PoseSource.ESTIMATED
            else "filled",
            source=None if pose is None else pose.source,
            pose=None if pose is None else _rig_pose(pose),
            refusal=None
            if answer.refusal is None
            else Refusal(
                stage=answer.refusal.stage,
                reason=answer.refusal.reason,
                message=answer.refusal.message,
            ),
            images=[_image_answer(image, pose) for image in answer.images],
            correspondences=correspondences,
            inliers=answer.num_inliers,
            inlier_ratio=answer.num_inliers / correspondences if correspondences else 0.0,
            map=MapRef(id=found.map_id, version=found.map_version),
            seconds=dict(answer.seconds),
            geopose=geopose,
            geopose_ypr=geopose_ypr,
            tile=found.tile,
        )


class LocalizeSequenceResponse(BaseModel):
    """The answers to a sequence."""

    request_id: Annotated[str, Field(description="the caller's, or made by the server")]
    answers: Annotated[list[InstantAnswer], Field(description="one per instant, in order")]


def _rig_pose(pose: visloc.types.RigPose) -> RigPose:
    return RigPose(
        rig_from_world=Transform.from_core(pose.rig_from_world),
        position=pose.rig_from_world.center.tolist(),
        orientation=pose.rig_from_world.inverse().rotation_wxyz.tolist(),
        covariance=pose.covariance.ravel().tolist(),
        position_std=pose.position_std.tolist(),
        orientation_std_deg=np.degrees(pose.orientation_std).tolist(),
    )


def _image_answer(
    image: visloc.types.ImageAnswer, pose: visloc.types.RigPose | None
) -> ImageAnswer:
    seen = image.evidence
    return ImageAnswer(
        sensor=image.sensor,
        error=None if image.error is None else ImageError.of(image.error),
        cam_from_world=None
        if pose is None
        else Transform.from_core(image.cam_from_rig @ pose.rig_from_world),
        keypoints=0 if seen is None else seen.num_keypoints,
        correspondences=0 if seen is None else seen.num_correspondences,
        inliers=0 if seen is None else seen.num_inliers,
        retrieved=[] if seen is None else RetrievedImage.best_of(seen, MAX_RETRIEVED),
        camera=None if seen is None else CameraUsed.of(seen),
        orientation=None if seen is None else Orientation.of(seen),
    )
