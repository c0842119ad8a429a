"""Answers as poses that fill others, and filled poses as answers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clients.wire.answers import (
    ImageResult,
    InstantResult,
    LocalizeResult,
    parse_pose,
    parse_result,
)
from clients.wire.requests import JsonObject
from clients.wire.rigs import Rig
from visloc.geometry import Pose, center_covariance
from visloc.sequences.filling import TracedPose, fill_rig
from visloc.types import PoseSource, Uncertainty
from visloc_api.words.poses import PoseEstimate, RigPose


def measured(pose: PoseEstimate, num_inliers: int) -> TracedPose:
    """Return the pose of an answer as a measured one."""
    return TracedPose(
        pose.cam_from_world,
        pose.covariance,
        PoseSource.ESTIMATED,
        uncertainty_of(pose),
        num_inliers,
    )


def uncertainty_of(pose: PoseEstimate | RigPose) -> Uncertainty:
    """Return what the covariance of an answer covers; a word that a newer server knows is less."""
    try:
        return Uncertainty(pose.uncertainty)
    except ValueError:
        return Uncertainty.PHOTO_ONLY


def pose_as_json(traced: TracedPose) -> JsonObject:
    """Return a pose ``cam_from_world`` as a PoseEstimate of the API.

    Without a probability and without a photo's part, which only the photos that measured the pose
    can tell.
    """
    pose = traced.pose
    variances = np.diag(center_covariance(pose, traced.covariance))
    stds = np.sqrt(np.maximum(variances, 0.0))
    return {
        "cam_from_world": {
            "rotation_wxyz": pose.rotation_wxyz.tolist(),
            "translation": pose.translation.tolist(),
        },
        "position": pose.center.tolist(),
        "orientation": pose.inverse().rotation_wxyz.tolist(),
        "covariance": traced.covariance.ravel().tolist(),
        "position_std": stds[3:].tolist(),
        "orientation_std_deg": np.degrees(stds[:3]).tolist(),
        "photo_covariance": [],
        "uncertainty": traced.uncertainty.value,
        "probability": None,
    }


def estimate_of(traced: TracedPose) -> PoseEstimate:
    """Return a pose as a PoseEstimate, as if it had been received."""
    return parse_pose(pose_as_json(traced))


def photo_result(result: InstantResult, index: int) -> LocalizeResult:
    """Return the answer to one photo of an instant.

    The pose is the rig's, seen from the camera. A photo without an inlier has none: the rig's
    pose then rests on the other cameras. Correspondences, inliers and retrieved images are the
    photo's own; the seconds are those of the whole instant.
    """
    image, raw = result.images[index], result.raw["images"][index]
    pose, status, refusal = None, result.status, result.raw["refusal"]
    if refusal is not None:
        # Candidates are poses of the rig, and a refusal does not tell where the camera sits in it.
        refusal = {**refusal, "candidates": []}
    if (traced := _measured_by(result, image)) is not None:
        assert result.pose is not None  # it was measured
        photo, turn = result.pose.photo_covariance, _turned_into(image, result.pose)
        pose = {
            **result.raw["pose"],  # what it has beyond the fields of the next line
            **pose_as_json(traced),
            "cam_from_world": raw["cam_from_world"],
            "photo_covariance": [] if photo is None else (turn @ photo @ turn.T).ravel().tolist(),
            "probability": result.pose.probability,
        }
        del pose["rig_from_world"]
    elif result.localized:
        status = "not_localized"
        refusal = {
            "stage": "pose",
            "reason": "no_inliers",
            "message": "no match of this photo agrees with the pose of its rig",
        }
    return parse_result(
        {
            "request_id": result.request_id,
            "status": status,
            "pose": pose,
            "refusal": refusal,
            "keypoints": image.keypoints,
            "correspondences": image.correspondences,
            "inliers": image.inliers,
            "inlier_ratio": image.inliers / max(image.correspondences, 1),
            "retrieved": raw["retrieved"],
            "camera": raw["camera"],
            "orientation": raw["orientation"],
            "map": result.raw["map"],
            "seconds": result.raw["seconds"],
        }
    )


def poses_from_rig(result: InstantResult, rig: Rig) -> dict[str, TracedPose]:
    """Return the poses, by sensor, of cameras whose photos contributed nothing to the rig's pose.

    They rest on the other cameras: their source is RIG, their covariance that of ``fill_rig``.

    Args:
        rig: the rig. For a rig that the map knows, only the answer tells where its cameras sit.
    """
    if not result.localized:
        return {}
    assert result.pose is not None
    world_from_rig = result.pose.rig_from_world.inverse()
    cam_from_rig: dict[str, Pose] = {
        image.sensor: image.cam_from_world @ world_from_rig
        for image in result.images
        if image.cam_from_world is not None
    }
    if not isinstance(rig, str):
        cam_from_rig = {name: sensor.cam_from_rig for name, sensor in rig.items()}
    measured_by = {image.sensor: _measured_by(result, image) for image in result.images}
    if not any(measured_by.values()):
        raise ValueError("a pose with no inlier in any photo")
    poses = fill_rig(dict.fromkeys(cam_from_rig) | measured_by, cam_from_rig)
    return {
        sensor: pose
        for sensor, pose in poses.items()
        if pose is not None and pose.source is PoseSource.RIG
    }


def _measured_by(result: InstantResult, image: ImageResult) -> TracedPose | None:
    """Return the pose of a camera whose photo contributed to its rig's pose."""
    if not result.localized or image.error is not None or image.inliers == 0:
        return None
    assert result.pose is not None
    if image.cam_from_world is None:
        raise ValueError("a photo without a pose in an instant with one")
    turn = _turned_into(image, result.pose)
    covariance = turn @ result.pose.covariance @ turn.T
    uncertainty = uncertainty_of(result.pose)
    return TracedPose(
        image.cam_from_world, covariance, PoseSource.ESTIMATED, uncertainty, image.inliers
    )


def _turned_into(image: ImageResult, rig: RigPose) -> NDArray[np.float64]:
    """Matrix (6, 6) from the rig's (w, dt) to that of a camera, which sees it rotated.

    R = R_c R_rig, t = R_c t_rig + t_c.
    """
    assert image.cam_from_world is not None  # the caller has looked
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = image.cam_from_world.rotation @ rig.rig_from_world.rotation.T
    return turn
