"""The answer to one photo."""

from __future__ import annotations

import base64
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, Field, PlainSerializer
from pydantic.json_schema import WithJsonSchema

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
from service.values import Localization, MatchPicture


class PoseEstimate(BaseModel):
    """Where the photo was taken, and how sure that is."""

    cam_from_world: Transform
    position: Annotated[
        list[float],
        Field(description="camera centre in the world, metres when the map is metric"),
    ]
    orientation: Annotated[
        list[float], Field(description="rotation of world_from_cam as w, x, y, z")
    ]
    covariance: Annotated[
        list[float],
        Field(
            description="6 x 6, row by row: rotation (rad), then translation, for "
            "R <- Exp(w) R and t <- t + dt of cam_from_world" + NOT_COVERED
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
            description="standard deviations about the camera's x, y and z axes, degrees"
            + NOT_COVERED
        ),
    ]


# Bytes in standard base64, as requests have them.
Base64 = Annotated[
    bytes,
    PlainSerializer(lambda data: base64.b64encode(data).decode()),
    WithJsonSchema({"type": "string", "contentEncoding": "base64"}),
]


class Debug(BaseModel):
    """What the solver was given, correspondence by correspondence, and what it made of it."""

    keypoints: Annotated[
        list[float],
        Field(description="x, y of each in pixels of the photo as stored, one after the other"),
    ]
    points: Annotated[
        list[float], Field(description="x, y, z of each in the world, one after the other")
    ]
    inliers: Annotated[
        list[bool], Field(description="of each: whether the best pose explains it, refused or not")
    ]
    overlay: Annotated[
        Base64,
        Field(description="JPEG: the photo with its matches, beside photos that it was found in"),
    ]

    @staticmethod
    def of(picture: MatchPicture) -> Debug:
        """Say it in the API's words."""
        return Debug(
            keypoints=picture.keypoints.ravel().tolist(),
            points=picture.points.ravel().tolist(),
            inliers=picture.inliers.tolist(),
            overlay=picture.overlay,
        )


class LocalizeResponse(BaseModel):
    """The answer: a pose, or the reason why there is none."""

    request_id: Annotated[str, Field(description="the caller's, or made by the server")]
    status: Literal["localized", "not_localized"]
    pose: Annotated[PoseEstimate | None, Field(description="null when not localized")]
    refusal: Annotated[Refusal | None, Field(description="null when localized")]
    keypoints: Annotated[int, Field(description="found in the photo")]
    correspondences: Annotated[int, Field(description="2D-3D matches given to the solver")]
    inliers: Annotated[
        int, Field(description="of them, those that agree with the best pose, refused or not")
    ]
    inlier_ratio: Annotated[float, Field(description="inliers / correspondences; 0 without any")]
    retrieved: Annotated[
        list[RetrievedImage], Field(description="mapping photos matched against, best first")
    ]
    camera: CameraUsed
    orientation: Orientation
    map: MapRef
    seconds: Annotated[dict[str, float], Field(description="wall time by stage that was reached")]
    geopose: Annotated[
        GeoPose | None,
        Field(description="of the camera; null when not localized or the map is not anchored"),
    ] = None
    geopose_ypr: Annotated[
        GeoPoseYpr | None, Field(description="the same in angles, when asked for")
    ] = None
    debug: Annotated[Debug | None, Field(description="the matches, when asked for")] = None
    tile: TileRef = None

    @staticmethod
    def from_localization(found: Localization, request_id: str) -> LocalizeResponse:
        """Say it in the API's words."""
        (image,), pose, refusal = found.answer.images, found.answer.pose, found.answer.refusal
        evidence = image.evidence
        assert evidence is not None  # a photo that cannot be used is an error
        cam_from_world = None if pose is None else pose.rig_from_world  # a rig of one camera
        geopose, geopose_ypr = geoposes_to_words(cam_from_world, found.geodetic, ypr=found.ypr)
        return LocalizeResponse(
            request_id=request_id,
            status="not_localized" if pose is None else "localized",
            pose=None if pose is None else _pose_estimate(pose),
            refusal=None
            if refusal is None
            else Refusal(stage=refusal.stage, reason=refusal.reason, message=refusal.message),
            keypoints=evidence.num_keypoints,
            correspondences=evidence.num_correspondences,
            inliers=evidence.num_inliers,
            inlier_ratio=evidence.inlier_ratio,
            retrieved=RetrievedImage.best_of(evidence),
            camera=CameraUsed.of(evidence),
            orientation=Orientation.of(evidence),
            map=MapRef(id=found.map_id, version=found.map_version),
            seconds=dict(found.answer.seconds),
            geopose=geopose,
            geopose_ypr=geopose_ypr,
            debug=None if found.debug is None else Debug.of(found.debug),
            tile=found.tile,
        )


def _pose_estimate(pose: visloc.types.RigPose) -> PoseEstimate:
    cam_from_world = pose.rig_from_world
    return PoseEstimate(
        cam_from_world=Transform.from_core(cam_from_world),
        position=cam_from_world.center.tolist(),
        orientation=cam_from_world.inverse().rotation_wxyz.tolist(),
        covariance=pose.covariance.ravel().tolist(),
        position_std=pose.position_std.tolist(),
        orientation_std_deg=np.degrees(pose.orientation_std).tolist(),
    )
