"""From what the engine found to the words of its answers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

import visloc.types
from service.values import Localization
from visloc.archive import Geodetic
from visloc.errors import VislocError
from visloc.geometry import Pose
from visloc.geopose import geopose_of
from visloc.types import PoseSource
from visloc_api.words.answers import (
    MAX_RETRIEVED,
    CameraUsed,
    Candidate,
    Debug,
    ImageAnswer,
    ImageError,
    InstantAnswer,
    LocalizeResponse,
    MapRef,
    Orientation,
    Refusal,
    RetrievedImage,
)
from visloc_api.words.geopose import GeoAngles, GeoPose, GeoPoseYpr, GeoPosition, GeoQuaternion
from visloc_api.words.poses import CoarsePose, PoseEstimate, RigPose


def localize_response(found: Localization, request_id: str) -> LocalizeResponse:
    """Answer a photo."""
    (image,), pose, refusal = found.answer.images, found.answer.pose, found.answer.refusal
    evidence = image.evidence
    assert evidence is not None  # a photo that cannot be used is an error
    cam_from_world = None if pose is None else pose.rig_from_world  # a rig of one camera
    geopose, geopose_ypr = geoposes_to_words(cam_from_world, found.geodetic, ypr=found.ypr)
    coarse = found.answer.coarse if pose is None else None
    return LocalizeResponse(
        request_id=request_id,
        status="localized" if pose is not None else "not_localized" if coarse is None else "coarse",
        pose=None if pose is None else _pose_estimate(pose, found),
        refusal=None if refusal is None else _refusal(refusal),
        keypoints=evidence.num_keypoints,
        correspondences=evidence.num_correspondences,
        inliers=evidence.num_inliers,
        inlier_ratio=evidence.inlier_ratio,
        retrieved=_retrieved(evidence.retrieved),
        camera=_camera(evidence),
        orientation=_orientation(evidence),
        map=MapRef(id=found.map_id, version=found.map_version),
        seconds=dict(found.answer.seconds),
        geopose=geopose,
        geopose_ypr=geopose_ypr,
        debug=None if found.debug is None else Debug.model_validate(found.debug),
        tile=found.tile,
        coarse=None if coarse is None else _coarse_pose(coarse, found),
    )


def instant_answer(found: Localization, request_id: str) -> InstantAnswer:
    """Answer the images of one instant."""
    answer = found.answer
    pose, correspondences = answer.pose, answer.num_correspondences
    rig_from_world = None if pose is None else pose.rig_from_world
    geopose, geopose_ypr = geoposes_to_words(rig_from_world, found.geodetic, ypr=found.ypr)
    return InstantAnswer(
        request_id=request_id,
        timestamp=answer.timestamp,
        status="not_localized"
        if pose is None
        else "localized"
        if pose.source is PoseSource.ESTIMATED
        else "filled",
        source=None if pose is None else pose.source,
        pose=None if pose is None else _rig_pose(pose, found),
        refusal=None if answer.refusal is None else _refusal(answer.refusal),
        images=tuple(_image_answer(image, pose) for image in answer.images),
        correspondences=correspondences,
        inliers=answer.num_inliers,
        inlier_ratio=answer.num_inliers / correspondences if correspondences else 0.0,
        map=MapRef(id=found.map_id, version=found.map_version),
        seconds=dict(answer.seconds),
        geopose=geopose,
        geopose_ypr=geopose_ypr,
        tile=found.tile,
    )


def _refusal(refusal: visloc.types.Refusal) -> Refusal:
    return Refusal(
        stage=refusal.stage,
        reason=refusal.reason,
        message=refusal.message,
        candidates=tuple(_candidate(each) for each in refusal.candidates),
    )


def _candidate(found: visloc.types.Candidate) -> Candidate:
    pose = found.rig_from_world
    map_id, _, version = found.map.partition("@")
    return Candidate(
        map=MapRef(id=map_id, version=version),
        tile=found.tile,
        position=pose.center,
        orientation=pose.inverse().rotation_wxyz,
        inliers=found.num_inliers,
        image=found.image,
        preference=found.preference,
    )


def _pose_estimate(pose: visloc.types.RigPose, found: Localization) -> PoseEstimate:
    return PoseEstimate.model_validate(
        {"cam_from_world": pose.rig_from_world, **_uncertain(pose, found)}
    )


def _coarse_pose(coarse: visloc.types.CoarsePose, found: Localization) -> CoarsePose:
    pose = coarse.cam_from_world
    return CoarsePose(
        cam_from_world=pose,
        position=pose.center,
        orientation=pose.inverse().rotation_wxyz,
        covariance=coarse.covariance,
        position_std=coarse.position_std,
        orientation_std_deg=np.degrees(coarse.orientation_std),
        method=coarse.method,
        metric=found.metric,
    )


def _rig_pose(pose: visloc.types.RigPose, found: Localization) -> RigPose:
    return RigPose.model_validate(
        {"rig_from_world": pose.rig_from_world, **_uncertain(pose, found)}
    )


def _uncertain(measured: visloc.types.RigPose, found: Localization) -> dict[str, Any]:
    pose = measured.rig_from_world
    return {
        "position": pose.center,
        "orientation": pose.inverse().rotation_wxyz,
        "covariance": measured.covariance,
        "position_std": measured.position_std,
        "orientation_std_deg": np.degrees(measured.orientation_std),
        "photo_covariance": measured.photo_covariance,
        "uncertainty": measured.uncertainty.value,
        "probability": measured.probability,
        "metric": found.metric,
    }


def _retrieved(images: Sequence[visloc.types.RetrievedImage]) -> tuple[RetrievedImage, ...]:
    return tuple(
        RetrievedImage(image=each.name, score=each.score, similarities=dict(each.similarities))
        for each in images
    )


def _camera(evidence: visloc.types.Evidence) -> CameraUsed:
    return CameraUsed.model_validate({"camera": evidence.camera, "source": evidence.camera_source})


def _orientation(evidence: visloc.types.Evidence) -> Orientation:
    return Orientation(
        exif=evidence.exif_orientation, read_as=evidence.read_as, turned=evidence.turned
    )


def _image_answer(
    image: visloc.types.ImageAnswer, pose: visloc.types.RigPose | None
) -> ImageAnswer:
    seen = image.evidence
    return ImageAnswer(
        sensor=image.sensor,
        error=None if image.error is None else _image_error(image.error),
        cam_from_world=None if pose is None else image.cam_from_rig @ pose.rig_from_world,
        keypoints=0 if seen is None else seen.num_keypoints,
        correspondences=0 if seen is None else seen.num_correspondences,
        inliers=0 if seen is None else seen.num_inliers,
        retrieved=() if seen is None else _retrieved(seen.retrieved[:MAX_RETRIEVED]),
        camera=None if seen is None else _camera(seen),
        orientation=None if seen is None else _orientation(seen),
    )


def _image_error(error: VislocError) -> ImageError:
    return ImageError(kind=type(error).__name__, code=error.code, message=str(error))


def geoposes_to_words(
    device_from_world: Pose | None, geodetic: Geodetic | None, *, ypr: bool
) -> tuple[GeoPose | None, GeoPoseYpr | None]:
    """Say a pose as GeoPoses: in a quaternion, and in angles where they are wanted.

    Both are None without a pose, and in a map that is not anchored to the Earth.
    """
    if device_from_world is None or geodetic is None:
        return None, None
    geopose = geopose_of(device_from_world, geodetic)
    position = GeoPosition(lat=geopose.latitude, lon=geopose.longitude, h=geopose.height)
    w, x, y, z = geopose.quaternion_wxyz.tolist()
    yaw, pitch, roll = geopose.angles_deg
    angles = GeoAngles(yaw=yaw, pitch=pitch, roll=roll)
    return (
        GeoPose(position=position, quaternion=GeoQuaternion(x=x, y=y, z=z, w=w)),
        GeoPoseYpr(position=position, angles=angles) if ypr else None,
    )
