"""The answer to a photo on its own, from the pose of the rig of one camera that it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from visloc.localization.solving import Look, Solved
from visloc.types import Answer, Localized, NotLocalized


def photo_answer(
    look: Look, solved: Solved, origin: NDArray[np.float64]
) -> tuple[Answer, NDArray[np.bool_]]:
    """State what was solved for one photo.

    Args:
        origin: (3,) of the map, in the world.

    Returns:
        The answer, and for each match (n,) whether the best pose explains it, even if that pose
        was refused.
    """
    answer, pose, refusal = solved.answer, solved.answer.pose, solved.answer.refusal
    none = np.zeros(len(look.matches.pixels), dtype=np.bool_)
    inliers = solved.inliers[0] if solved.inliers else none
    (image,) = answer.images
    assert image.evidence is not None  # it was looked at
    evidence = replace(image.evidence, seconds=answer.seconds)
    if refusal is not None or pose is None or pose.photo_covariance is None:
        assert refusal is not None  # without a pose there is a reason
        told = (refusal.stage, refusal.reason, refusal.message, refusal.candidates)
        return NotLocalized(evidence, *told, coarse=answer.coarse), inliers
    localized = Localized(
        evidence=evidence,
        pose=pose,
        inlier_keypoints=(look.matches.pixels[inliers] * look.reduced).astype(np.float32),
        inlier_points=look.matches.points[inliers] + origin,
    )
    return localized, inliers
