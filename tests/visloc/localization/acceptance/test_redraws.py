from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from visloc.geometry import Pose, center_covariance
from visloc.localization.acceptance import corrections
from visloc.localization.acceptance.gates import Problem
from visloc.localization.map_view.constraints import Constraints
from visloc.localization.solving import Matches, SeenImage, Solved, solve_instant
from visloc.options import LocalizeOptions
from visloc.pose.reprojection import normalized_rays
from visloc.priors import NO_PRIORS
from visloc.types import CameraSource, Reason

TRUTH = Pose(Rotation.from_rotvec([0.3, -1.2, 0.4]).as_matrix(), np.array([1.0, -2.0, 0.5]))
BESIDE = Pose(Rotation.from_euler("y", 90, degrees=True).as_matrix(), np.array([0.2, 0.1, 0.3]))
TRIALS = 16


def smeared(place: Any, pose: Pose, length_px: float, seed: int) -> Matches:
    """300 matches of a photo that moved along a line: anywhere on the line a keypoint is found."""
    matches = place.matches(pose, 300, seed=seed, noise=1.0)
    rng = np.random.default_rng(1000 + seed)
    angle = rng.uniform(0.0, np.pi)
    along = rng.uniform(-0.5, 0.5, (300, 1)) * length_px * [np.cos(angle), np.sin(angle)]
    return replace(matches, pixels=matches.pixels + along)


def facade(place: Any, seed: int) -> Matches:
    """110 right and 300 wrong matches; the right ones lie on a small plane, seen nearly frontally.

    Of such a plane two poses explain nearly the same (Schweighofer and Pinz 2006).
    """
    rng = np.random.default_rng(seed)
    pixels = rng.normal([322.0, 239.0], (60.0, 40.0), (110, 2))
    rays = normalized_rays(place.camera, pixels)
    normal = np.array([np.sin(0.2), 0.0, np.cos(0.2)])
    points = TRUTH.inverse().apply(rays * (30.0 * normal[2] / (rays @ normal))[:, None])
    wrong = TRUTH.center + rng.uniform(-40.0, 40.0, (300, 3))
    pixels = pixels + rng.normal(size=pixels.shape) * 3.0
    anywhere = rng.uniform([5, 5], [635, 475], (300, 2))
    return Matches(np.vstack([pixels, anywhere]), np.vstack([points, wrong]))


def photo(place: Any, length_px: float, seed: int) -> list[SeenImage]:
    return [place.image(smeared(place, TRUTH, length_px, seed))]


def rig(place: Any, length_px: float, seed: int) -> list[SeenImage]:
    return [
        place.image(smeared(place, each @ TRUTH, length_px, seed), sensor=name, cam_from_rig=each)
        for name, each in (("ahead", Pose.identity()), ("beside", BESIDE))
    ]


def solve(images: list[SeenImage], place: Any) -> Solved:
    return solve_instant(images, place.geometry, LocalizeOptions(), NO_PRIORS)


def distances2(solved: list[Solved], place: Any) -> np.ndarray:
    """Squared errors in units of the stated covariance."""
    found = []
    for each in solved:
        pose = each.answer.pose
        assert pose is not None
        at, truth = pose.rig_from_world, place.to_world(TRUTH)
        turned = Rotation.from_matrix(at.rotation @ truth.rotation.T).as_rotvec()
        error = np.concatenate([turned, at.center - truth.center])
        found.append(error @ np.linalg.solve(center_covariance(at, pose.covariance), error))
    return np.array(found)


@pytest.mark.parametrize("make", [photo, rig])
def test_of_smeared_photos_the_stated_covariance_grows_to_what_is_true(
    make: Any, place: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    images = [make(place, 40.0, seed) for seed in range(TRIALS)]
    answered = [solved for each in images if (solved := solve(each, place)).answer.pose]
    monkeypatch.setattr(corrections, "_is_asked", lambda *_: False)
    of_one_minimum = [solved for each in images if (solved := solve(each, place)).answer.pose]
    assert len(answered) == len(of_one_minimum) >= TRIALS // 2
    before, after = distances2(of_one_minimum, place), distances2(answered, place)
    limit = chi2.ppf(0.95, 6)
    assert np.mean(before <= limit) <= 0.2
    assert np.mean(after <= limit) >= 0.4
    assert np.median(after) <= np.median(before) / 4


def test_of_a_facade_the_wrong_one_of_two_poses_is_refused_or_stated_as_uncertain(
    place: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    images = [[place.image(facade(place, seed))] for seed in range(TRIALS)]
    answered = [solved for each in images if (solved := solve(each, place)).answer.pose]
    monkeypatch.setattr(corrections, "_is_asked", lambda *_: False)
    of_one_minimum = [solved for each in images if (solved := solve(each, place)).answer.pose]
    limit = chi2.ppf(0.999, 6)
    assert np.sum(distances2(of_one_minimum, place) > 10 * limit) >= 2
    assert len(answered) >= 4
    assert np.all(distances2(answered, place) <= limit)


def test_a_sharp_photo_is_not_searched_again(place: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    image = place.image(place.matches(TRUTH, 400, 100, seed=1, noise=2.0))
    monkeypatch.setattr(corrections, "widening", None)
    assert solve([image], place).answer.pose is not None


def test_the_covariance_of_a_pose_that_holds_stays_as_it_is(place: Any) -> None:
    """Asked for draws, although nothing lies beyond the threshold, it hardly grows."""
    for seed in range(4):
        solved = solve([place.image(place.matches(TRUTH, 200, 100, seed=seed))], place)
        assert solved.pose is not None
        constraints = Constraints(place.geometry, NO_PRIORS)
        problem = Problem(solved.views, (CameraSource.GIVEN,), LocalizeOptions(), constraints)
        assert 1.0 <= corrections.widening(problem, solved.pose) <= 2.0


def test_a_pose_that_other_draws_do_not_find_at_all_is_refused(
    place: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    images = photo(place, 40.0, 0)
    assert solve(images, place).answer.pose is not None
    monkeypatch.setattr(corrections, "widening", lambda *_: np.inf)
    refusal = solve(images, place).answer.refusal
    assert refusal is not None
    assert refusal.reason is Reason.UNCERTAIN_POSE
    assert "draws of its matches" in refusal.message
