"""Answers with given inliers, poses and uncertainty."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from visloc.geometry import Camera, Pose
from visloc.options import ReadAs
from visloc.pose.motion import position_covariance
from visloc.types import (
    CameraSource,
    Evidence,
    ImageAnswer,
    InstantAnswer,
    PoseSource,
    Reason,
    Refusal,
    RigPose,
    Uncertainty,
)

CAMERA = Camera("PINHOLE", 64, 48, (50.0, 50.0, 32.0, 24.0))


def localized(
    inliers: int, center: Any = (0, 0, 0), turn: float = 0.0, std: float = 0.01
) -> InstantAnswer:
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
    rig = RigPose(
        pose,
        covariance,
        spread,
        np.full(3, 1e-4),
        PoseSource.ESTIMATED,
        covariance,
        Uncertainty.WHOLE,
    )
    image = ImageAnswer("camera", Pose.identity(), evidence, None)
    return InstantAnswer(None, (image,), rig, None, {})


def refused(inliers: int, reason: Reason = Reason.TOO_FEW_INLIERS) -> InstantAnswer:
    refusal = Refusal("gate", reason, "refused")
    return replace(localized(inliers), pose=None, refusal=refusal)
