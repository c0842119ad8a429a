"""Matches reach the search in the order that they were given in, the best first."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from visloc.evaluation import pose_error
from visloc.geometry import Camera, Pose
from visloc.localization.solving import solve_instant
from visloc.options import DEFAULT_PRESET, PRESETS, LocalizeOptions
from visloc.pose.generalized import estimate_generalized_pose
from visloc.pose.motion import UncertainPose
from visloc.pose.reprojection import MatchedView, normalized_rays
from visloc.priors import NO_PRIORS, PosePrior, Priors
from visloc.sequences.group import find_groups

TRUTH = Pose(Rotation.from_rotvec([0.3, -1.2, 0.4]).as_matrix(), np.array([1.0, -2.0, 0.5]))
RIG = [
    Pose(Rotation.from_euler("y", 90 * i, degrees=True).as_matrix(), np.array([0.2, 0.1 * i, 0.3]))
    for i in range(3)
]
CAMERA = Camera("PINHOLE", 640, 480, (500.0, 510.0, 322.0, 239.0))


def record_searches(monkeypatch: pytest.MonkeyPatch, module: str) -> list[list[MatchedView]]:
    """The views of every search that ``module`` asks for, from now on."""
    searched: list[list[MatchedView]] = []

    def search(views: Any, **options: Any) -> Any:
        searched.append(list(views))
        return estimate_generalized_pose(views, **options)

    monkeypatch.setattr(f"{module}.estimate_generalized_pose", search)
    return searched


def rows_in(part: MatchedView, whole: MatchedView) -> list[int]:
    row_of = {pixel.tobytes(): row for row, pixel in enumerate(whole.pixels)}
    return [row_of[pixel.tobytes()] for pixel in part.pixels]


def assert_ordered(part: MatchedView, whole: MatchedView) -> None:
    rows = rows_in(part, whole)
    assert rows == sorted(rows)


@pytest.mark.parametrize("with_prior", [False, True])
def test_those_of_a_rig_of_its_halves_and_of_its_draws(
    place: Any, monkeypatch: pytest.MonkeyPatch, with_prior: bool
) -> None:
    images = [
        place.image(
            place.matches(cam_from_rig @ TRUTH, 20, 20, seed=i),
            sensor=f"cam{i}",
            cam_from_rig=cam_from_rig,
        )
        for i, cam_from_rig in enumerate(RIG)
    ]
    wholes = [
        MatchedView(
            CAMERA, image.cam_from_rig, image.look.matches.pixels, image.look.matches.points
        )
        for image in images
    ]
    searched = record_searches(monkeypatch, "visloc.localization.acceptance.gates")
    priors = Priors(pose=PosePrior(TRUTH, 0.01 * np.eye(6))) if with_prior else NO_PRIORS
    solved = solve_instant(images, place.geometry, LocalizeOptions(), priors)
    assert solved.pose is not None
    whole_rig, first, second, *draws = searched
    assert [rows_in(*views) for views in zip(whole_rig, wholes, strict=True)] == [[*range(40)]] * 3
    assert len(draws) == 8
    for half in (first, second):
        for part, whole in zip(half, wholes, strict=True):
            assert 0 < len(part) <= 20
            assert_ordered(part, whole)
    for draw in draws:
        for part, whole in zip(draw, wholes, strict=True):
            assert 0 < len(part) <= 40
            assert_ordered(part, whole)


def test_those_of_a_group_of_instants_that_is_thinned(
    monkeypatch: pytest.MonkeyPatch, place: Any
) -> None:
    instants = []
    for i in range(2):
        matches = place.matches(TRUTH, 1000, 1000, seed=i)
        instants.append([MatchedView(CAMERA, Pose.identity(), matches.pixels, matches.points)])
    searched = record_searches(monkeypatch, "visloc.sequences.group")
    still = UncertainPose(Pose.identity(), 1e-8 * np.eye(6))
    assert list(find_groups(instants, [still], PRESETS[DEFAULT_PRESET], seed=0))
    (views,) = searched
    assert 2000 < sum(map(len, views)) < 3900
    for part, (whole,) in zip(views, instants, strict=True):
        assert_ordered(part, whole)


def test_the_search_looks_at_the_best_of_thousands() -> None:
    """Two in a hundred are right, which are found because they are the best."""
    rng = np.random.default_rng(1)
    pixels = rng.uniform([5, 5], [635, 475], (4000, 2))
    points = TRUTH.inverse().apply(normalized_rays(CAMERA, pixels) * rng.uniform(1, 8, (4000, 1)))
    points[80:] = np.roll(points[80:], 1, axis=0)
    # They are not the very best.
    order = np.concatenate([rng.permutation(200), np.arange(200, 4000)])
    best = MatchedView(CAMERA, Pose.identity(), pixels[order], points[order])
    found = estimate_generalized_pose([best], max_error_px=4.0, seed=0)
    assert found is not None
    assert pose_error(found.rig_from_world, TRUTH)[0] < 1e-3
