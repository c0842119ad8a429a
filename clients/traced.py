"""From answers to poses that can be filled, and from filled poses to what answers look like."""

from __future__ import annotations

import numpy as np

from clients.answers import parse_pose, parse_result
from clients.requests import JsonObject
from clients.rigs import InstantResult
from clients.types import LocalizeResult, PoseEstimate
from visloc.trajectory import PoseSource, TracedPose, center_covariance


def measured(pose: PoseEstimate, num_inliers: int) -> TracedPose:
    """Return a pose that a photo gave."""
    return TracedPose(pose.cam_from_world, pose.covariance, PoseSource.ESTIMATED, num_inliers)


def pose_as_json(traced: TracedPose) -> JsonObject:
    """Return a pose ``cam_from_world`` as the API has a PoseEstimate."""
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
    }


def estimate_of(traced: TracedPose) -> PoseEstimate:
    """Return a pose as if it had been received."""
    return parse_pose(pose_as_json(traced))


def photo_result(result: InstantResult, index: int) -> LocalizeResult:
    """Return what the answer to an instant says of one of its photos, which could be used.

    The pose is the rig's, seen from the camera; correspondences, inliers and what was retrieved
    are the photo's own; the seconds are those of the whole instant.

    Raises:
        KeyError, TypeError, ValueError, InvalidInput: for answers that contradict themselves.
    """
    image, raw = result.images[index], result.raw["images"][index]
    pose = None
    if result.localized:
        assert result.pose is not None
        if image.cam_from_world is None:
            raise ValueError("a photo without a pose in an instant with one")
        # (w, dt) of the rig arrive at the camera turned: R = R_c R_rig, t = R_c t_rig + t_c.
        turn = np.zeros((6, 6))
        cam_from_rig = image.cam_from_world.rotation @ result.pose.rig_from_world.rotation.T
        turn[:3, :3] = turn[3:, 3:] = cam_from_rig
        covariance = turn @ result.pose.covariance @ turn.T
        traced = TracedPose(image.cam_from_world, covariance, PoseSource.ESTIMATED, image.inliers)
        pose = pose_as_json(traced) | {"cam_from_world": raw["cam_from_world"]}
    return parse_result(
        {
            "request_id": result.request_id,
            "status": result.status,
            "pose": pose,
            "refusal": result.raw["refusal"],
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
