"""How good poses are: errors, recall within thresholds, medians and percentiles.

Definitions as in Sattler et al., "Benchmarking 6DOF Outdoor Visual Localization in Changing
Conditions", CVPR 2018, section 3.3, and in kapture's evaluation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visloc.errors import refuse
from visloc.geometry import Pose, center_covariance, rotation_angle

# Below it, chi-square with three degrees of freedom lies with 95 %.
CHI2_95_OF_3 = 7.814727903251178


@dataclass(frozen=True, slots=True)
class Threshold:
    """A pose is within it when neither error is larger.

    Attributes:
        max_position_error_m: metres.
        max_orientation_error_deg: degrees.
    """

    max_position_error_m: float
    max_orientation_error_deg: float

    def __post_init__(self) -> None:
        # Written so that NaN fails too.
        if not (self.max_position_error_m >= 0 and self.max_orientation_error_deg >= 0):
            raise refuse(
                "evaluation.threshold",
                field="threshold",
                expected="metres and degrees, neither negative",
                got=f"{self.max_position_error_m} m, {self.max_orientation_error_deg} degrees",
            )


# Indoors (7-Scenes), then the high, medium and low precision of Sattler et al.
DEFAULT_THRESHOLDS = (
    Threshold(0.05, 5.0),
    Threshold(0.25, 2.0),
    Threshold(0.5, 5.0),
    Threshold(5.0, 10.0),
)


def pose_error(estimated: Pose, truth: Pose) -> tuple[float, float]:
    """Compare two ``cam_from_world``.

    Returns:
        The distance between the camera centres in the unit of the world (metres), and the angle
        of the rotation between the two orientations in degrees, 0 to 180.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # infinite, or NaN, when that far away
        position_error = float(np.linalg.norm(estimated.center - truth.center))
    orientation_error = rotation_angle(estimated.rotation @ truth.rotation.T)
    return position_error, math.degrees(orientation_error)


def recall(
    errors: Sequence[tuple[float, float]],
    num_queries: int,
    thresholds: Sequence[Threshold] = DEFAULT_THRESHOLDS,
) -> list[float]:
    """Return for each threshold the fraction of all queries within it, bounds included.

    Args:
        errors: (metres, degrees) of each localized query, as ``pose_error`` gives them.
        num_queries: all queries; those without an error count as failures.
    """
    if not 0 < num_queries >= len(errors):
        raise refuse(
            "evaluation.num_queries",
            field="num_queries",
            expected=f"at least one, and not fewer than the {len(errors)} localized",
            got=num_queries,
        )
    return [
        sum(
            position <= threshold.max_position_error_m
            and orientation <= threshold.max_orientation_error_deg
            for position, orientation in errors
        )
        / num_queries
        for threshold in thresholds
    ]


def median_errors_localized(errors: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Return the medians (metres, degrees) over the localized queries; NaN if there are none."""
    if not errors:
        return math.nan, math.nan
    position, orientation = np.median(np.asarray(errors, dtype=np.float64), axis=0)
    return float(position), float(orientation)


def percentile(values: Sequence[float], percent: float) -> float:
    """Return the smallest value that at least ``percent`` % of the values do not exceed.

    This is the nearest-rank definition: the answer is always one of the values, as befits
    latencies, where the slowest of few must not be interpolated away. NaN without values.
    """
    if not values:
        return math.nan
    return float(np.percentile(values, percent, method="inverted_cdf"))


@dataclass(frozen=True, slots=True)
class Calibration:
    """Whether stated uncertainties of positions hold.

    Attributes:
        inside_95: share of the true positions inside the stated ellipsoid of 95 %.
        median_ratio: median of the error over the stated deviation, the root of the covariance's
            trace. Where the covariance is right and round it is 0.89; 0.67 where it is a line.
            Infinite where that is zero.
    """

    inside_95: float
    median_ratio: float


def calibration(
    poses: Sequence[tuple[Pose, NDArray[np.float64], Pose]],
) -> Calibration | None:
    """Compare errors of positions with the deviations that were stated.

    Args:
        poses: estimated pose, its covariance (6, 6), and the true pose; all device_from_world.

    Returns:
        None when there are none.
    """
    if not poses:
        return None
    inside, ratios = [], []
    for pose, covariance, truth in poses:
        with np.errstate(over="ignore", invalid="ignore"):
            error = pose.center - truth.center
            stated = center_covariance(pose, covariance)[3:, 3:]
        if not (np.isfinite(stated).all() and np.isfinite(error).all()):
            inside.append(bool(np.isfinite(error).all()))  # what is so uncertain may be anywhere
            ratios.append(0.0 if inside[-1] else math.inf)
            continue
        # The pseudo-inverse takes a covariance that is zero along an axis.
        inside.append(float(error @ np.linalg.pinv(stated) @ error) <= CHI2_95_OF_3)
        spread = math.sqrt(float(np.trace(stated)))
        ratios.append(float(np.linalg.norm(error)) / spread if spread > 0 else math.inf)
    return Calibration(float(np.mean(inside)), float(np.median(ratios)))
