from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from visloc.evaluation import pose_error
from visloc.geometry import CAMERA_MODELS, Camera, Pose
from visloc.pose.motion import moved
from visloc.pose.refinement import LOSS_SCALE_PX, refine
from visloc.pose.reprojection import (
    MatchedView,
    linearized,
    normalized_rays,
    project,
    reprojection_errors,
)

CAMERA = Camera("PINHOLE", 640, 480, (500.0, 510.0, 322.0, 239.0))
RIG = [
    Pose.identity(),
    Pose(Rotation.from_euler("y", 90, degrees=True).as_matrix(), np.array([0.2, 0.0, 0.3])),
]


def look(
    seed: int, n: int, camera: Camera = CAMERA, noise_px: float = 0.0, num_wrong: int = 0
) -> tuple[list[MatchedView], Pose]:
    """Views of a rig, n correspondences each, the first ``num_wrong`` off by up to 100 px."""
    rng = np.random.default_rng(seed)
    truth = Pose(Rotation.from_rotvec(rng.normal(size=3)).as_matrix(), rng.normal(size=3))
    views = []
    for cam_from_rig in RIG:
        pixels = rng.uniform([5, 5], [635, 475], (n, 2))
        seen = normalized_rays(camera, pixels) * rng.uniform(2.0, 8.0, (n, 1))
        pixels += noise_px * rng.normal(size=pixels.shape)
        pixels[:num_wrong] += rng.uniform(-100.0, 100.0, (num_wrong, 2))
        points = (cam_from_rig @ truth).inverse().apply(seen)
        views.append(MatchedView(camera, cam_from_rig, pixels, points))
    return views, truth


def near(pose: Pose, size: float) -> Pose:
    return moved(pose, size * np.array([0.6, -0.3, 0.5, 1.0, -2.0, 0.7]))


def loss(views: list[MatchedView], pose: Pose, max_error_px: float) -> float:
    errors = np.concatenate([reprojection_errors(view, pose) for view in views])
    shortened = np.fmin(errors, max_error_px)
    return float(np.sum(LOSS_SCALE_PX**2 / 2 * np.log1p((shortened / LOSS_SCALE_PX) ** 2)))


@pytest.mark.parametrize("model", sorted(CAMERA_MODELS))
@pytest.mark.parametrize("about", [np.zeros(3), np.array([1.0, -2.0, 0.5])])
def test_the_derivatives_are_those_of_the_errors(model: str, about: NDArray[np.float64]) -> None:
    values = {"f": 500.0, "fx": 500.0, "fy": 505.0, "cx": 320.0, "cy": 240.0, "omega": 0.8}
    camera = Camera(model, 640, 480, tuple(values.get(p, 1e-3) for p in CAMERA_MODELS[model]))
    views, truth = look(1, 5, camera)
    errors, jacobian = linearized(views, truth, about)
    assert np.abs(errors).max() < 1e-6
    size = 1e-6
    for parameter, change in enumerate(size * np.eye(6)):
        there, back = Pose(np.eye(3), -about), Pose(np.eye(3), about)
        after = back @ moved(there @ truth, change)
        projected = [project(v.camera, (v.cam_from_rig @ after).apply(v.points)) for v in views]
        difference = np.concatenate(projected) - np.concatenate([v.pixels for v in views])
        assert difference / size == pytest.approx(jacobian[:, :, parameter], rel=1e-3, abs=0.1)


def test_exact_correspondences_give_the_exact_pose_from_a_pose_nearby() -> None:
    views, truth = look(2, 40, num_wrong=10)
    found = refine(views, near(truth, 0.01), max_error_px=12.0)
    assert found is not None
    distance, angle = pose_error(found.rig_from_world, truth)
    assert distance < 1e-8
    assert angle < 1e-6
    assert all(mask[10:].all() for mask in found.inliers)


def test_the_pose_is_the_best_nearby_and_its_inliers_are_its_own() -> None:
    views, truth = look(3, 100, noise_px=1.5, num_wrong=40)
    found = refine(views, near(truth, 0.005), max_error_px=8.0)
    assert found is not None
    assert found.loss == pytest.approx(loss(views, found.rig_from_world, 8.0))
    for mask, view in zip(found.inliers, views, strict=True):
        assert np.array_equal(mask, reprojection_errors(view, found.rig_from_world) <= 8.0)
    for change in np.vstack([np.eye(6), -np.eye(6)]):
        worse = loss(views, moved(found.rig_from_world, 1e-3 * change), 8.0)
        assert worse > found.loss


def test_correspondences_in_a_line_leave_a_pose_that_explains_them() -> None:
    views, truth = look(4, 20)
    line = replace(views[0], pixels=np.linspace([100.0, 100.0], [500.0, 400.0], 20))
    seen = 3.0 * normalized_rays(CAMERA, line.pixels)
    line = replace(line, points=truth.inverse().apply(seen))
    found = refine([line], near(truth, 0.002), max_error_px=12.0)
    assert found is not None
    assert found.num_inliers == 20
    assert found.mean_loss < 1e-6


def test_points_that_leave_the_view_are_no_inliers_and_do_no_harm() -> None:
    views, truth = look(5, 30)
    views[0].points[:10] = truth.inverse().apply(np.array([0.3, 0.2, -4.0]))
    views[0].points[10:12] = truth.inverse().apply(np.array([1.0, 1.0, 1e-12]))
    found = refine(views, near(truth, 0.005), max_error_px=12.0)
    assert found is not None
    assert pose_error(found.rig_from_world, truth)[0] < 1e-8
    assert found.num_inliers == 48


def at_the_edge(points: NDArray[np.float64]) -> tuple[MatchedView, Pose]:
    """What a lens of 180 degrees sees of a hemisphere and of ``points``, and a pose nearby."""
    camera = Camera("OPENCV_FISHEYE", 640, 640, (200.0, 200.0, 320.0, 320.0, 0.0, 0.0, 0.0, 0.0))
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(300, 3))
    directions[:, 2] = np.abs(directions[:, 2]) + 0.01
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    seen = np.vstack([directions * rng.uniform(3.0, 8.0, (300, 1)), points])
    pixels = project(camera, seen) + 0.7 * np.random.default_rng(2).normal(size=(len(seen), 2))
    view = MatchedView(camera, Pose.identity(), pixels, seen)
    return view, Pose(np.eye(3), np.array([0.05, 0.03, 0.0]))


@pytest.mark.parametrize("count", [1, 20])
def test_points_at_the_very_edge_of_a_fisheye_do_not_stop_the_others(count: int) -> None:
    """Their errors are numbers, but have no derivative."""
    angle = np.arange(count)
    edge = np.column_stack([5.0 * np.cos(angle), 5.0 * np.sin(angle), np.full(count, 2e-5)])
    (plain, start), (view, _) = at_the_edge(np.empty((0, 3))), at_the_edge(edge)
    without = refine([plain], start, max_error_px=12.0)
    found = refine([view], start, max_error_px=12.0)
    assert without is not None
    assert found is not None
    assert np.linalg.norm(without.rig_from_world.translation) < 0.005
    assert np.linalg.norm(found.rig_from_world.translation) < 0.005


def test_points_at_the_very_edge_alone_give_none() -> None:
    view, start = at_the_edge(np.array([[5.0, 0.0, 2e-5]] * 10))
    assert refine([view.selected(np.arange(297, 310))], start, max_error_px=12.0) is None


def test_too_few_inliers_give_none() -> None:
    views, truth = look(6, 3)
    assert refine(views[:1], truth, max_error_px=12.0) is None
    assert refine([], truth, max_error_px=12.0) is None
    views, truth = look(6, 30)
    assert refine(views, near(truth, 2.0), max_error_px=2.0) is None


_PRINT_A_POSE = """
import numpy as np
import test_refinement
views, truth = test_refinement.look(7, 6000, noise_px=1.0, num_wrong=2000)
from visloc.pose.generalized import estimate_generalized_pose
found = estimate_generalized_pose(views, max_error_px=12.0, seed=3)
pose = found.rig_from_world
for array in (pose.rotation, pose.translation, found.covariance):
    print(array.tobytes().hex())
"""


def test_the_number_of_threads_does_not_change_a_bit() -> None:
    here = str(Path(__file__).parent)
    answers = set()
    for threads in ("1", "2"):
        names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
        environment = os.environ | dict.fromkeys(names, threads)
        environment["PYTHONPATH"] = os.pathsep.join([here, *sys.path])
        answers.add(
            subprocess.run(
                [sys.executable, "-c", _PRINT_A_POSE],
                env=environment,
                check=True,
                capture_output=True,
                text=True,
            ).stdout
        )
    assert len(answers) == 1
