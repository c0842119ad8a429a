"""The accuracy of poses whose true poses are known, as plain JSON."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from visloc.evaluation import (
    Threshold,
    calibration,
    median_errors_localized,
    pose_error,
    recall,
)
from visloc.geometry import Pose

_PERCENTILES = {"p50": 50, "p75": 75, "p90": 90, "max": 100}


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """A photo whose true pose is known.

    Attributes:
        pose: the estimated ``cam_from_world``; None when the photo has none.
        covariance: (6, 6) of ``pose``, of rotation (rad) then translation; None when unknown.
    """

    truth: Pose
    pose: Pose | None
    covariance: NDArray[np.float64] | None = None


def accuracy_of(photos: Sequence[Compared], thresholds: Sequence[Threshold]) -> dict[str, Any]:
    """Summarize errors; null where there is no figure.

    Recall counts all photos; those without a pose are failures. ``median_*`` and percentiles are
    over the photos that have a pose. ``median_*_of_all`` take a photo without a pose for infinitely
    wrong, as hloc and kapture do, and are null where that is the median.
    """
    errors = [pose_error(each.pose, each.truth) for each in photos if each.pose is not None]
    median_position_m, median_orientation_deg = median_errors_localized(errors)
    failed = [(math.inf, math.inf)] * (len(photos) - len(errors))
    all_position_m, all_orientation_deg = median_errors_localized(errors + failed)
    held = calibration(
        [
            (each.pose, each.covariance, each.truth)
            for each in photos
            if each.pose is not None and each.covariance is not None
        ]
    )
    return {
        "median_position_error_m": finite(median_position_m),
        "median_orientation_error_deg": finite(median_orientation_deg),
        "median_position_error_of_all_m": finite(all_position_m),
        "median_orientation_error_of_all_deg": finite(all_orientation_deg),
        "position_error_m": _error_percentiles([position for position, _ in errors]),
        "orientation_error_deg": _error_percentiles([orientation for _, orientation in errors]),
        "calibration": None
        if held is None
        else {"inside_95": held.inside_95, "median_ratio": finite(held.median_ratio)},
        "recall": _recall(errors, len(photos), thresholds),
    }


def finite(value: float) -> float | None:
    """Return None for what JSON cannot hold."""
    return value if math.isfinite(value) else None


def _error_percentiles(values: Sequence[float]) -> dict[str, float | None] | None:
    # Interpolated, so that p50 is the median above.
    if not values:
        return None
    with np.errstate(invalid="ignore"):  # between errors that are infinite
        found = np.percentile(values, list(_PERCENTILES.values())).tolist()
    return {name: finite(value) for name, value in zip(_PERCENTILES, found, strict=True)}


def _recall(
    errors: Sequence[tuple[float, float]], num_queries: int, thresholds: Sequence[Threshold]
) -> list[dict[str, float]] | None:
    if num_queries == 0:
        return None
    fractions = recall(errors, num_queries, thresholds)
    return [
        {
            "max_position_error_m": threshold.max_position_error_m,
            "max_orientation_error_deg": threshold.max_orientation_error_deg,
            "fraction": fraction,
        }
        for threshold, fraction in zip(thresholds, fractions, strict=True)
    ]
