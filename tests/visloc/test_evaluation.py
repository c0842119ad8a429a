from __future__ import annotations

import math

import numpy as np
import pytest

from visloc.errors import InvalidInput
from visloc.evaluation import (
    DEFAULT_THRESHOLDS,
    Threshold,
    median_errors_localized,
    percentile,
    pose_error,
    recall,
)
from visloc.geometry import Pose


def camera_at(center: tuple[float, float, float], yaw_deg: float) -> Pose:
    half = math.radians(yaw_deg) / 2
    turn = Pose.from_quaternion([math.cos(half), 0, 0, math.sin(half)], [0, 0, 0])
    return Pose(turn.rotation, -turn.rotation @ np.array(center))


@pytest.mark.parametrize("yaw_deg", [0.0, 1e-6, 0.03, 30.0, 179.999, 180.0])
def test_pose_error_tells_the_shift_and_turn_that_were_applied(yaw_deg: float) -> None:
    truth = camera_at((100.0, -20.0, 3.0), 10.0)
    estimated = camera_at((100.0, -20.3, 3.4), 10.0 + yaw_deg)

    position_error, orientation_error = pose_error(estimated, truth)

    assert position_error == pytest.approx(0.5)
    assert orientation_error == pytest.approx(yaw_deg, abs=1e-9)
    assert pose_error(truth, estimated) == pytest.approx((position_error, orientation_error))


def test_a_pose_has_no_error_against_itself() -> None:
    pose = camera_at((1.0, 2.0, 3.0), 77.0)
    assert pose_error(pose, pose) == (0.0, 0.0)


def test_a_turn_about_the_camera_does_not_move_it() -> None:
    position_error, _ = pose_error(camera_at((50, 0, 0), 0), camera_at((50, 0, 0), 90))
    assert position_error == pytest.approx(0.0, abs=1e-12)


def test_recall_counts_missing_poses_as_failures_and_includes_the_bounds() -> None:
    errors = [(0.05, 5.0), (0.050001, 1.0), (0.25, 2.0001), (6.0, 0.0)]
    assert recall(errors, num_queries=8) == [1 / 8, 1 / 8, 3 / 8, 3 / 8]
    assert recall(errors, 4, [Threshold(math.inf, math.inf)]) == [1.0]
    assert recall([], 3) == [0.0] * len(DEFAULT_THRESHOLDS)


def test_an_error_that_is_not_a_number_is_a_failure() -> None:
    assert recall([(math.nan, 0.0)], 1, [Threshold(1, 1)]) == [0.0]


@pytest.mark.parametrize(("errors", "num_queries"), [([], 0), ([(1.0, 1.0)] * 2, 1), ([], -1)])
def test_a_wrong_number_of_queries_is_refused(
    errors: list[tuple[float, float]], num_queries: int
) -> None:
    with pytest.raises(InvalidInput) as caught:
        recall(errors, num_queries)
    assert caught.value.code == "evaluation.num_queries"


@pytest.mark.parametrize("bounds", [(-0.1, 1.0), (1.0, -1.0), (math.nan, 1.0), (1.0, math.nan)])
def test_a_threshold_that_cannot_be_is_refused(bounds: tuple[float, float]) -> None:
    with pytest.raises(InvalidInput) as caught:
        Threshold(*bounds)
    assert caught.value.code == "evaluation.threshold"


def test_medians_are_those_of_the_localized() -> None:
    errors = [(0.1, 3.0), (0.3, 1.0), (0.2, 2.0)]
    assert median_errors_localized(errors) == (0.2, 2.0)
    assert all(math.isnan(value) for value in median_errors_localized([]))


def test_percentiles_are_values_that_occurred() -> None:
    values = [float(value) for value in range(100, 0, -1)]
    assert [percentile(values, percent) for percent in (50, 90, 99, 100)] == [50, 90, 99, 100]
    assert percentile([3.0, 1.0, 2.0], 99) == 3.0
    assert percentile([7.0], 50) == 7.0
    assert math.isnan(percentile([], 50))
