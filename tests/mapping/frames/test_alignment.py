from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mapping.frames.alignment import NoTie, Seen, Tie, refined_on_points, tie
from visloc.geometry import Camera, Pose, Similarity, rotation_angle
from visloc.pose.reprojection import project

CAMERA = Camera("OPENCV", 640, 480, (520.0, 525.0, 320.0, 240.0, 0.1, -0.05, 0.0, 0.001))
TURN = Rotation.from_euler("xyz", [20.0, -35.0, 140.0], degrees=True).as_matrix()
# The other frame counts from far away, as projected coordinates do.
THERE_FROM_HERE = Similarity(1.0, TURN, np.array([400_000.0, -30.0, 2.5]))
SCALED = replace(THERE_FROM_HERE, scale=3.2)


def seen_photos(
    there_from_here: Similarity, seed: int, count: int = 12, noise_px: float = 1.0
) -> list[Seen]:
    """Photos of a room, each localized with an error of its own of centimetres."""
    random = np.random.default_rng(seed)
    points = random.uniform([-4, -4, 0], [4, 4, 3], (800, 3))
    photos = []
    for _ in range(count):
        rotation = Rotation.from_euler("y", random.uniform(-0.6, 0.6)).as_matrix()
        center = np.append(random.uniform(-3, 3, 2), -7.0)
        pose = Pose(rotation, -rotation @ center)
        in_cam = pose.apply(points)
        pixels = project(CAMERA, in_cam)
        kept = np.flatnonzero(((pixels > 0) & (pixels < (640, 480))).all(axis=1))[:150]
        off = random.normal(scale=0.01, size=3)
        localized = Pose(
            Rotation.from_rotvec(0.3 * off).as_matrix() @ pose.rotation, pose.translation + off
        )
        photos.append(
            Seen(
                pose,
                CAMERA,
                pixels[kept] + random.normal(scale=noise_px, size=(len(kept), 2)),
                there_from_here.apply(points[kept]),
                there_from_here.move(localized),
            )
        )
    return photos


def error_of(found: Similarity, truth: Similarity, at: NDArray[np.float64]) -> tuple[float, float]:
    """Distance between where both put a place, and the angle in degrees."""
    distance = np.linalg.norm(found.apply(at) - truth.apply(at))
    return float(distance), float(np.degrees(rotation_angle(found.rotation @ truth.rotation.T)))


@pytest.mark.parametrize(("truth", "rigid"), [(THERE_FROM_HERE, True), (SCALED, False)])
def test_all_matches_together_tell_more_than_the_poses(truth: Similarity, rigid: bool) -> None:
    found = tie(seen_photos(truth, seed=1), rigid=rigid)

    assert isinstance(found, Tie)
    distance, angle = error_of(found.there_from_here, truth, np.array([0.0, 0.0, -3.0]))
    assert distance < 0.006 * truth.scale
    assert angle < 0.05
    assert found.there_from_here.scale == pytest.approx(truth.scale, rel=0 if rigid else 2e-3)
    assert found.tied.all()
    assert (found.errors_px < 2).all()
    assert 0.005 * truth.scale < np.median(found.distances) < 0.05 * truth.scale


def test_photos_without_noise_tell_it_exactly() -> None:
    found = tie(seen_photos(SCALED, seed=2, noise_px=0.0), rigid=False)

    assert isinstance(found, Tie)
    distance, angle = error_of(found.there_from_here, SCALED, np.zeros(3))
    assert distance < 1e-4
    assert angle < 1e-3


def test_photos_that_go_back_count_too() -> None:
    here = seen_photos(SCALED, seed=3, count=3, noise_px=2.0)
    back = [
        replace(
            seen,
            pose_here=SCALED.move(seen.pose_here),
            points=SCALED.inverse().apply(seen.points),
            pose_there=SCALED.inverse().move(seen.pose_there),
        )
        for seen in seen_photos(SCALED, seed=4, noise_px=0.3)
    ]
    truth = np.zeros(3)
    alone, together = (tie(here, photos, rigid=False) for photos in ((), back))

    assert isinstance(alone, Tie)
    assert isinstance(together, Tie)
    assert (alone.num_back, together.num_back) == (0, len(back))
    assert (
        error_of(together.there_from_here, SCALED, truth)[0]
        < 0.5 * error_of(alone.there_from_here, SCALED, truth)[0]
    )


def test_points_that_depth_gave_in_both_frames_tell_more() -> None:
    random = np.random.default_rng(12)
    photos = [
        replace(
            seen,
            own_points=SCALED.inverse().apply(seen.points)
            + random.normal(scale=0.005, size=seen.points.shape),
        )
        for seen in seen_photos(SCALED, seed=12, count=5, noise_px=2.0)
    ]
    bare = [replace(seen, own_points=None) for seen in photos]
    found, without = (tie(some, rigid=False) for some in (photos, bare))

    assert isinstance(found, Tie)
    assert isinstance(without, Tie)
    distance, angle = error_of(found.there_from_here, SCALED, np.zeros(3))
    assert distance < 0.003 < error_of(without.there_from_here, SCALED, np.zeros(3))[0]
    assert angle < 0.02
    assert found.tied.all()


@pytest.mark.parametrize(("factor", "tied"), [(1.01, True), (1.1, False), (0.9, False)])
def test_depth_of_another_unit_than_the_poses_ties_nothing(factor: float, tied: bool) -> None:
    def lifted(seen: Seen) -> Seen:
        in_cam = seen.pose_here.apply(SCALED.inverse().apply(seen.points))
        return replace(seen, own_points=seen.pose_here.inverse().apply(factor * in_cam))

    found = tie([lifted(seen) for seen in seen_photos(SCALED, seed=13)], rigid=False)

    assert isinstance(found, Tie) == tied, found
    assert tied or f"{factor:.3g} times as far" in str(found)
    assert isinstance(found, Tie) or found.unit


def test_photos_that_were_localized_elsewhere_do_not_count() -> None:
    good = seen_photos(THERE_FROM_HERE, seed=5)
    wrong = seen_photos(
        replace(THERE_FROM_HERE, translation=np.array([400_003.0, -30.0, 2.5])), seed=6, count=5
    )
    found = tie([*wrong, *good], rigid=True)

    assert isinstance(found, Tie)
    assert found.tied.tolist() == [False] * 5 + [True] * 12
    assert error_of(found.there_from_here, THERE_FROM_HERE, np.zeros(3))[0] < 0.005
    assert (found.distances[:5] > 2).all()


def test_equal_seeds_give_equal_ties() -> None:
    photos = seen_photos(SCALED, seed=7, count=5)
    first, second = (tie(photos, rigid=False, seed=3) for _ in range(2))

    assert isinstance(first, Tie)
    assert isinstance(second, Tie)
    assert first.there_from_here.translation.tolist() == second.there_from_here.translation.tolist()


def test_photos_of_another_building_agree_on_nothing() -> None:
    random = np.random.default_rng(8)
    elsewhere = [
        seen_photos(replace(THERE_FROM_HERE, translation=place), seed=row, count=1)[0]
        for row, place in enumerate(random.uniform(-20, 20, (8, 3)))
    ]

    found = tie(elsewhere, rigid=True)

    assert isinstance(found, NoTie)
    assert not found.unit
    assert "of 8 localized photos agree" in found.why


def test_two_photos_are_too_few() -> None:
    assert "only 2 photos" in str(tie(seen_photos(THERE_FROM_HERE, seed=9, count=2), rigid=True))


def test_photos_at_one_place_do_not_tell_the_scale_but_a_rigid_tie() -> None:
    random = np.random.default_rng(10)
    seen = seen_photos(THERE_FROM_HERE, seed=10, count=1)[0]
    together = []
    for _ in range(6):
        own, localized = (
            Pose(
                seen.pose_here.rotation,
                seen.pose_here.translation + random.normal(scale=off, size=3),
            )
            for off in (0.01, 0.02)
        )
        pixels = project(CAMERA, own.apply(THERE_FROM_HERE.inverse().apply(seen.points)))
        there = THERE_FROM_HERE.move(localized)
        together.append(replace(seen, pose_here=own, pixels=pixels, pose_there=there))

    assert "too close together" in str(tie(together, rigid=False))
    assert isinstance(tie(together, rigid=True), Tie)


@pytest.mark.parametrize(("scale", "tied"), [(1.01, True), (1.03, False), (0.95, False)])
def test_metric_frames_of_different_metres_are_not_tied(scale: float, tied: bool) -> None:
    found = tie(seen_photos(replace(THERE_FROM_HERE, scale=scale), seed=1), rigid=True)

    assert isinstance(found, Tie) == tied, found
    assert tied or f"is {scale:.3g} metres there" in str(found)


def test_a_point_alone_does_not_turn_a_frame() -> None:
    here = np.zeros((5, 3))
    assert refined_on_points(SCALED, here, SCALED.apply(here) + 1.0, rigid=False) is SCALED


@pytest.mark.parametrize(("truth", "rigid"), [(THERE_FROM_HERE, True), (SCALED, False)])
def test_points_known_in_both_frames_tell_it_though_a_third_of_them_is_wrong(
    truth: Similarity, rigid: bool
) -> None:
    random = np.random.default_rng(2)
    here = random.uniform([-4, -4, 0], [4, 4, 3], (3000, 3))
    there = truth.apply(here + random.normal(scale=0.02, size=here.shape))
    there[::3] += truth.scale * random.uniform(0, 2, (1000, 3))
    turn = Rotation.from_rotvec([0.01, 0.015, -0.01]).as_matrix()
    start = replace(truth, rotation=truth.rotation @ turn, translation=truth.translation + 0.03)
    found = refined_on_points(start, here, there, rigid=rigid)
    distance, angle = error_of(found, truth, np.zeros(3))
    assert distance / truth.scale < 0.01
    assert angle < 0.1
    assert found.scale == pytest.approx(truth.scale, rel=0 if rigid else 3e-3)


def test_points_without_noise_tell_it_exactly() -> None:
    here = np.random.default_rng(3).uniform(-4, 4, (50, 3))
    found = refined_on_points(SCALED, here, SCALED.apply(here), rigid=False)
    assert error_of(found, SCALED, here[0])[0] < 1e-6
