"""Answers with given inliers, poses and uncertainty."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from visloc.geometry import Camera, Pose
from visloc.pose.centre import position_covariance
from visloc.sequences.filling import PoseSource
from visloc.types import (
    CameraSource,
    Evidence,
    ImageAnswer,
    InstantAnswer,
    Localized,
    NotLocalized,
    ReadAs,
    Reason,
    RigPose,
)

CAMERA = Camera("PINHOLE", 64, 48, (50.0, 50.0, 32.0, 24.0))


def localized(inliers: int, center: Any = (0, 0, 0), turn: float = 0.0, std: float = 0.01) -> Any:
    rotation = Rotation.from_rotvec([0, 0, turn]).as_matrix()
    pose = Pose(rotation, -rotation @ np.asarray(center, dtype=np.float64))
    # Of the centre, as large in all directions.
    covariance = np.diag([1e-8] * 3 + [std**2] * 3)
    evidence = Evidence(
        CAMERA,
        CameraSource.GIVEN,
        1,
        ReadAs.STORED,
        num_correspondences=2 * inliers,
        num_inliers=inliers,
    )
    spread = np.sqrt(np.diag(position_covariance(pose, covariance)))
    return Localized(
        evidence,
        pose,
        covariance,
        spread,
        np.full(3, 1e-4),
        np.zeros((0, 2), np.float32),
        np.zeros((0, 3)),
    )


def refused(inliers: int, reason: Reason = Reason.TOO_FEW_INLIERS) -> NotLocalized:
    return NotLocalized(localized(inliers).evidence, "gate", reason, "refused")


def of_rig(inliers: int, center: Any = (0, 0, 0), std: float = 0.01) -> InstantAnswer:
    one = localized(inliers, center, std=std)
    rig = RigPose(
        one.cam_from_world,
        one.covariance,
        one.position_std,
        one.orientation_std,
        PoseSource.ESTIMATED,
    )
    image = ImageAnswer("cam", Pose.identity(), one.evidence, None)
    return InstantAnswer(0, (image,), rig, None, {})
