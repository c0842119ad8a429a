from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from visloc.archive import MapStore
from visloc.evaluation import pose_error
from visloc.features import make_local_features
from visloc.geometry import Pose
from visloc.localization.constraints import Constraints
from visloc.localization.evidence import Shown
from visloc.localization.gates import Problem, accepted
from visloc.localization.guided import (
    SURE,
    Guided,
    expected_pose,
    guided_matches,
    is_worth_guiding,
)
from visloc.localization.localizer import Localizer
from visloc.localization.rivals import Proposed
from visloc.matching.correspondences import Proposals
from visloc.matching.products import EightBitRows
from visloc.options import LocalizeOptions
from visloc.pose.colmap import project
from visloc.pose.views import MatchedView
from visloc.priors import NO_PRIORS
from visloc.types import CameraSource, Reason, Refusal

PHOTO, OTHERS = 3, (0, 5, 7)
FEW = Refusal("gate", Reason.LOW_INLIER_RATIO, "few")


@pytest.fixture(scope="module")
def localizer(built_maps: Path) -> Localizer:
    return Localizer(MapStore(built_maps).open("room"), make_local_features("sift"))


def shown_at(localizer: Localizer) -> tuple[Shown, MatchedView, Pose]:
    """All that a mapping photo shows, its right matches, and its pose."""
    opened, geometry = localizer.map, localizer.geometry
    camera = opened.cameras[opened.images[PHOTO].camera]
    pose = geometry.viewpoints.pose(PHOTO)
    landmarks, descriptors = opened.observations(PHOTO)
    points = opened.landmarks[landmarks].astype(np.float64)
    pixels = project(camera, pose.apply(points))
    scale = opened.manifest.local_features.descriptor_scale
    shown = Shown(pixels.astype(np.float32), EightBitRows(descriptors.copy(), scale))
    return shown, MatchedView(camera, Pose.identity(), pixels, points), pose


def guided(localizer: Localizer, shown: Shown, pose: Pose) -> Guided:
    camera = localizer.map.cameras[localizer.map.images[PHOTO].camera]
    tree = KDTree(shown.keypoints.astype(np.float64))
    found = guided_matches(localizer.geometry, shown, tree, camera, pose, 12.0)
    assert found is not None
    return found


def turned(pose: Pose, degrees: float) -> Pose:
    rotation = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    return Pose(rotation @ pose.rotation, rotation @ pose.translation)


def test_landmarks_are_found_where_the_right_pose_predicts_them(localizer: Localizer) -> None:
    shown, view, pose = shown_at(localizer)
    found = guided(localizer, shown, pose)
    assert found.support > SURE
    errors = np.linalg.norm(project(view.camera, pose.apply(found.points)) - found.pixels, axis=1)
    assert np.mean(errors < 2.0) > 0.8
    assert len(np.unique(found.pixels, axis=0)) == len(found.pixels)


def test_a_wrong_pose_has_no_more_support_than_chance(localizer: Localizer) -> None:
    shown, _, pose = shown_at(localizer)
    for degrees in (-12.0, 9.0, 15.0):
        assert guided(localizer, shown, turned(pose, degrees)).support < 4.0


def test_a_photo_that_looks_like_something_else_gives_no_support(localizer: Localizer) -> None:
    shown, _, pose = shown_at(localizer)
    rows = np.roll(shown.descriptors.rows, len(shown.keypoints) // 3, axis=0)
    other = replace(shown, descriptors=EightBitRows(rows, shown.descriptors.scale))
    assert guided(localizer, other, pose).support < 4.0


def test_very_many_keypoints_give_no_support(localizer: Localizer) -> None:
    """The nearest of them all lie in the middle of the disc in which a landmark is looked for."""
    shown, view, pose = shown_at(localizer)
    random = np.random.default_rng(0)
    rows = np.tile(shown.descriptors.rows, (20_000 // len(shown.keypoints), 1))
    size = view.camera.width, view.camera.height
    keypoints = random.uniform((0, 0), size, (len(rows), 2)).astype(np.float32)
    crowded = Shown(keypoints, EightBitRows(random.permutation(rows), shown.descriptors.scale))
    for degrees in (0.0, 9.0, 15.0):
        assert guided(localizer, crowded, turned(pose, degrees)).support < 4.0


def doubtful(localizer: Localizer, num_right: int) -> tuple[Problem, Proposed, Pose]:
    """A photo of which so many matches are right, and two thousand wrong."""
    shown, view, pose = shown_at(localizer)
    random = np.random.default_rng(0)
    num_keypoints, num_wrong = len(shown.keypoints), 2000
    right = random.permutation(num_keypoints)[:num_right]
    keypoints = np.concatenate([right, random.integers(0, num_keypoints, num_wrong)])
    landmarks = np.concatenate(
        [
            localizer.map.observations(PHOTO)[0][right].astype(np.int64),
            random.integers(0, len(localizer.map.landmarks), num_wrong),
        ]
    )
    # A tenth of the wrong ones come from the photo that has the right ones.
    ranks = np.concatenate([np.zeros(num_right), random.integers(0, 10, num_wrong)])
    ranks = np.minimum(ranks, len(OTHERS)).astype(np.int64)
    pairs = Proposals(keypoints, landmarks, ranks, np.ones(len(keypoints), np.float32))
    points = localizer.map.landmarks[landmarks]
    proposed = Proposed(shown, pairs, points, np.array([PHOTO, *OTHERS]))
    pixels = shown.keypoints[keypoints].astype(np.float64)
    every = replace(view, pixels=pixels, points=points.astype(np.float64))
    constraints = Constraints(localizer.geometry, NO_PRIORS)
    options = LocalizeOptions()
    problem = Problem((every,), (CameraSource.GIVEN,), options, constraints, (shown,))
    return problem, proposed, pose


def test_a_pose_that_a_fiftieth_of_the_matches_supports_is_found(localizer: Localizer) -> None:
    problem, proposed, pose = doubtful(localizer, 45)
    found = expected_pose(problem, proposed, None)
    assert found is not None
    distance, degrees = pose_error(found.rig_from_world, pose)
    assert distance < 0.02
    assert degrees < 0.3
    refusal = accepted(problem, found)[1]
    assert refusal is not None
    assert refusal.reason is Reason.LOW_INLIER_RATIO
    judged, refusal = accepted(problem, found, expected=True)
    assert judged.probability is not None
    assert refusal is None or refusal.reason is Reason.UNLIKELY_POSE


def test_wrong_matches_alone_have_no_pose(localizer: Localizer) -> None:
    problem, proposed, _ = doubtful(localizer, 0)
    rows = np.roll(proposed.shown.descriptors.rows, len(proposed.shown.keypoints) // 3, axis=0)
    scale = proposed.shown.descriptors.scale
    shown = replace(proposed.shown, descriptors=EightBitRows(rows, scale))
    assert expected_pose(problem, replace(proposed, shown=shown), None) is None


def test_only_single_photos_with_default_thresholds_are_guided(localizer: Localizer) -> None:
    problem, _, _ = doubtful(localizer, 45)
    assert is_worth_guiding(problem, FEW)
    assert not is_worth_guiding(problem, replace(FEW, reason=Reason.CAMERA_CONTRADICTED))
    assert not is_worth_guiding(replace(problem, views=problem.views * 2), FEW)
    guessed = replace(problem.views[0], focal_unknown=True)
    assert not is_worth_guiding(problem.of([guessed]), FEW)
    assert not is_worth_guiding(replace(problem, shown=()), FEW)
    for options in (
        LocalizeOptions(preset="config1"),
        LocalizeOptions(max_error_px=40),
        LocalizeOptions(min_inliers=50),
        LocalizeOptions(min_inlier_ratio=0.1),
    ):
        assert not is_worth_guiding(replace(problem, options=options), FEW)
