from __future__ import annotations

import numpy as np
import pytest

from mapping.stages.landmarks import (
    Observations,
    View,
    assemble_landmarks,
    reprojection_errors,
    triangulation_angles,
)
from visloc.geometry import Camera, Pose

CAMERA = Camera("PINHOLE", 100, 100, (100.0, 100.0, 50.0, 50.0))


def view_from(x: float, z: float = 0.0) -> View:
    return View(CAMERA, Pose(np.eye(3), np.array([-x, 0.0, -z])))


def observed(*rows: tuple[int, int, int, float, float]) -> Observations:
    table = np.array(rows)
    whole = table[:, :3].astype(np.int64)
    return Observations(whole[:, 0], whole[:, 1], whole[:, 2], table[:, 3:].astype(np.float32))


def test_the_angle_of_a_point_is_the_largest_between_two_of_its_rays() -> None:
    views = [view_from(-1.0), view_from(0.0), view_from(1.0)]
    points = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [0.0, 0.0, 5.0]])
    seen = observed(
        *((0, 0, 0, 0, 0), (0, 1, 0, 0, 0), (0, 2, 0, 0, 0)),  # 45 left, straight, 45 right
        *((1, 0, 0, 0, 0), (1, 1, 0, 0, 0)),
        (2, 0, 0, 0, 0),
    )
    angles = triangulation_angles(views, points, seen)
    assert angles.dtype == np.float32
    assert angles.tolist() == pytest.approx([90.0, 45.0, 0.0, 0.0], abs=1e-4)


def test_a_point_at_a_camera_has_no_angle_and_raises_nothing() -> None:
    views = [view_from(0.0), view_from(1.0)]
    seen = observed((0, 0, 0, 0, 0), (0, 1, 0, 0, 0))
    assert np.isfinite(triangulation_angles(views, np.zeros((1, 3)), seen)).all()


def test_errors_are_pixels_and_nan_behind_the_camera() -> None:
    views = [view_from(0.0)]
    points = np.array([[0.0, 0.0, 2.0], [0.0, 0.0, -2.0]])
    errors = reprojection_errors(views, points, observed((0, 0, 0, 53, 54), (1, 0, 1, 50, 50)))
    assert errors[0] == pytest.approx(5.0)
    assert np.isnan(errors[1])


def test_observations_come_out_by_photo_and_rows_tell_which_features_they_were() -> None:
    views = [view_from(0.0), view_from(1.0)]
    points = np.array([[0.0, 0.0, 2.0], [0.5, 0.0, 2.0], [0.0, 0.0, 9.0]])
    seen = observed((1, 1, 7, 25, 50), (0, 0, 3, 50, 53), (1, 0, 4, 75, 50), (0, 1, 9, 0, 50))
    landmarks, rows = assemble_landmarks(views, points, seen)
    assert landmarks.offsets.tolist() == [0, 2, 4]
    assert landmarks.observed.tolist() == [0, 1, 1, 0]
    assert [own.tolist() for own in rows] == [[3, 4], [7, 9]]
    assert landmarks.track_lengths.tolist() == [2, 2, 0]
    assert landmarks.errors_px[:2].tolist() == pytest.approx([1.5, 0.0])
    assert np.isnan(landmarks.errors_px[2])  # nobody sees it
    assert np.isnan(landmarks.angles_deg).all()
    assert landmarks.origin.tolist() == [0.0, 0.0, 0.0]


def test_far_from_the_origin_points_are_told_from_near_the_photos() -> None:
    views = [view_from(600_000.4)]
    points = np.array([[600_000.123, 0.0, 2.0]])
    landmarks, _ = assemble_landmarks(views, points, observed((0, 0, 0, 50, 50)))
    assert landmarks.origin.tolist() == [600_000.0, 0.0, 0.0]
    assert landmarks.points[0] == pytest.approx([0.123, 0.0, 2.0], abs=1e-7)
