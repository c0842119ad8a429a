"""Instants of a sequence, moved from a tile to the frame of a set."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.values import SequenceJob
from visloc.errors import InvalidInput
from visloc.geometry import Camera, Pose, Similarity
from visloc.localization.acceptance.corrections import NO_CAMERAS
from visloc.localization.solving import Solved
from visloc.options import LocalizeOptions
from visloc.pose.generalized import GeneralizedPose
from visloc.pose.motion import MapErrors, position_covariance
from visloc.pose.reprojection import MatchedView
from visloc.sequences.filling import Odometry, TimeUnit
from visloc.types import InstantAnswer, Reason, Refusal
from visloc_extensions.sets.run import SetFrame, SetRun, solved_in_set

CAMERA = Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))
TURN = Rotation.from_euler("zyx", [40, -20, 10], degrees=True).as_matrix()


def test_instant_moved_to_the_set_shows_the_same_picture() -> None:
    random = np.random.default_rng(0)
    mounted = Pose(TURN.T, np.array([0.1, 0.0, 0.3]))
    points = random.uniform(-5, 5, (20, 3))
    view = MatchedView(CAMERA, mounted, np.zeros((20, 2)), points)
    spread = random.normal(size=(6, 6)) * 0.01
    pose = GeneralizedPose(
        Pose(TURN, np.array([1.0, 2.0, 3.0])), (np.ones(20, np.bool_),), spread @ spread.T
    )
    answer = InstantAnswer(0, (), None, Refusal("gate", Reason.NO_POSE, "none"), {})
    errors = MapErrors(1.5, 1.2, position_std=0.2)
    solved = Solved(answer, (view,), pose, pose.inliers, NO_CAMERAS, errors)
    set_from_tile = Similarity(2.5, TURN, np.array([30.0, -4.0, 7.0]))

    moved = solved_in_set(solved, set_from_tile, np.array([4.0, 5.0, 6.0]), np.full(3, 20.0))

    (seen,) = moved.views
    assert moved.pose is not None
    assert moved.pose.covariance is not None
    there = (seen.cam_from_rig @ moved.pose.rig_from_world).apply(seen.points)
    here = (mounted @ pose.rig_from_world).apply(points)
    np.testing.assert_allclose(there, 2.5 * here)
    center = set_from_tile.apply(pose.rig_from_world.center + np.array([4.0, 5.0, 6.0])) - 20.0
    np.testing.assert_allclose(moved.pose.rig_from_world.center, center)
    assert pose.covariance is not None
    before = position_covariance(pose.rig_from_world, pose.covariance)
    after = position_covariance(moved.pose.rig_from_world, moved.pose.covariance)
    np.testing.assert_allclose(after, 2.5**2 * TURN @ before @ TURN.T)
    assert moved.errors.position_std == pytest.approx(0.5)
    assert moved.answer is answer


def test_pose_out_of_sight_of_all_tiles_leads_out(outline: Callable[..., Any]) -> None:
    frame = SetFrame(outline([((0, 0, 0), (1, 1, 1)), ((10, 0, 0), (11, 1, 1))], reach=3.0))
    assert frame.leads_out(np.array([13.0, 0.5, 0.5]) - frame.origin) is None
    away = frame.leads_out(np.array([5.5, 0.5, 0.5]) - frame.origin)
    assert away == pytest.approx(4.5)


def test_odometry_in_a_set_that_is_not_metric_needs_a_metric_tile(
    outline: Callable[..., Any],
) -> None:
    known = outline([((0, 0, 0), (1, 1, 1))])
    world = known.manifest.world.model_copy(update={"metric": False})
    known = type(known)(
        known.manifest.model_copy(update={"world": world}), known.photo_boxes, known.reaches
    )
    start = SequenceJob(("town",), None, TimeUnit.MS, 10.0, LocalizeOptions())
    run = SetRun(start, known, SetFrame(known))
    moved = Odometry(Pose(TURN, np.array([1.0, 2.0, 3.0])), np.eye(6))

    scaled = run._in_unit(moved, 0.1)
    assert scaled is not None
    np.testing.assert_allclose(scaled.rig_from_odometry.translation, [0.1, 0.2, 0.3])
    assert scaled.covariance is not None
    np.testing.assert_allclose(np.diag(scaled.covariance), [1, 1, 1, 0.01, 0.01, 0.01])
    with pytest.raises(InvalidInput) as caught:
        run._in_unit(moved, None)
    assert caught.value.code == "sequence.odometry"
