from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from mapping.pairing import PairSettings, Scene
from mapping.pairing.frustum import MIN_OVERLAP, pair_by_frustum
from visloc.errors import InvalidInput
from visloc.geometry import Camera, Pose

Make = Callable[..., Scene]
Looking = Callable[..., Pose]
RandomPoses = Callable[..., list[Pose]]
SETTINGS = PairSettings(near=0.5, far=50.0)


def score_by_sampling(scene: Scene, settings: PairSettings, i: int, j: int) -> float:
    """The definition, point by point: pixels times depths, projected and tested."""
    return min(overlap_by_sampling(scene, settings, *ab) for ab in ((i, j), (j, i)))


def overlap_by_sampling(scene: Scene, settings: PairSettings, a: int, b: int) -> float:
    pose_a, pose_b = scene.cam_from_world[a], scene.cam_from_world[b]
    assert pose_a is not None
    assert pose_b is not None
    u, v = np.meshgrid((np.arange(8) + 0.5) / 4 - 1, (np.arange(6) + 0.5) / 3 - 1)
    steps = (np.arange(400) + 0.5) / 400
    depths = settings.near * (settings.far / settings.near) ** steps
    rays = np.column_stack([u.ravel(), v.ravel(), np.ones(48)])
    points = pose_a.inverse().apply((depths[:, None, None] * rays).reshape(-1, 3))
    x, y, z = pose_b.apply(points).T
    from_a, from_b = points - pose_a.center, points - pose_b.center
    lengths = np.linalg.norm(from_a, axis=1) * np.linalg.norm(from_b, axis=1)
    cosine = np.einsum("pi,pi->p", from_a, from_b) / lengths
    seen = (z >= settings.near) & (z <= settings.far) & (np.abs(x) <= z) & (np.abs(y) <= z)
    return float(np.mean(seen & (cosine > math.cos(math.radians(60.0)))))


def test_the_same_view_overlaps_entirely(make_scene: Make, looking: Looking) -> None:
    pairs = pair_by_frustum(make_scene([looking([1, 2, 3], 20.0, 10.0)] * 2), SETTINGS)

    assert pairs.rows.tolist() == [[0, 1]]
    assert pairs.scores[0] == pytest.approx(1.0, abs=1e-12)


def test_a_step_forward_loses_the_depths_in_between(make_scene: Make, looking: Looking) -> None:
    pairs = pair_by_frustum(make_scene([looking([0, 0, 0]), looking([0, 0, 9])]), SETTINGS)

    # A ray from behind with slope m enters the front view where m z = z - 9, at depth 0.5 or more.
    u, v = np.meshgrid((np.arange(8) + 0.5) / 4 - 1, (np.arange(6) + 0.5) / 3 - 1)
    slope = np.maximum(np.abs(u), np.abs(v))
    shared = np.log(np.maximum(50 / np.maximum(9 / (1 - slope), 9.5), 1.0))
    assert pairs.scores[0] == pytest.approx(shared.mean() / math.log(100), abs=1e-9)


@pytest.mark.parametrize("distance", [0.0, 1.0, 5.0, 12.0, 20.0, 49.0, 80.0])
def test_opposite_views_of_the_same_place_do_not_pair(
    make_scene: Make, looking: Looking, distance: float
) -> None:
    face_to_face = make_scene([looking([0, 0, 0]), looking([0, 0, distance], 180.0)])
    back_to_back = make_scene([looking([0, 0, distance]), looking([0, 0, 0], 180.0)])

    assert len(pair_by_frustum(face_to_face, SETTINGS)) == 0
    assert len(pair_by_frustum(back_to_back, SETTINGS)) == 0


def test_views_of_one_place_pair_from_near_sides_and_not_from_across(
    make_scene: Make, looking: Looking
) -> None:
    def from_side(yaw: float) -> Pose:  # 5 away from the origin, looking at it
        direction = np.array([np.sin(np.radians(yaw)), 0.0, np.cos(np.radians(yaw))])
        return looking(-5.0 * direction, yaw)

    scene = make_scene([from_side(0.0), from_side(30.0), from_side(150.0)])

    assert pair_by_frustum(scene, SETTINGS).rows.tolist() == [[0, 1]]


@pytest.mark.parametrize(
    ("center", "yaw", "pitch"),
    [
        ([0.5, 0, 0], 0.0, 0.0),
        ([4, -1, 0], 0.0, 0.0),
        ([0, 0, 7], 5.0, -10.0),
        ([0, 0, -7], 5.0, -10.0),
        ([0, 0, 0], 40.0, 0.0),
        ([0, 0, 0], 0.0, 60.0),
        ([6, 1, 2], -50.0, 5.0),
        ([3, 0, -1], 15.0, 20.0),
    ],
)
def test_closed_form_equals_sampling_the_definition(
    make_scene: Make, looking: Looking, center: list[float], yaw: float, pitch: float
) -> None:
    scene = make_scene([looking([0, 0, 0], 3.0), looking(center, yaw, pitch)])

    pairs = pair_by_frustum(scene, SETTINGS)

    expected = score_by_sampling(scene, SETTINGS, 0, 1)
    assert expected > MIN_OVERLAP
    assert pairs.scores[0] == pytest.approx(expected, abs=0.003)


@pytest.mark.parametrize("extent", [(8.0, 2.5, 6.0), (300.0, 3.0, 200.0)])
def test_pairs_equal_those_of_sampling_all_pairs(
    make_scene: Make, random_poses: RandomPoses, extent: tuple[float, ...]
) -> None:
    scene = make_scene(random_poses(30, 2, extent))

    found = pair_by_frustum(scene, PairSettings(top_k=50))

    pairs = {(i, j): s for (i, j), s in zip(found.rows.tolist(), found.scores, strict=True)}
    for i in range(30):
        for j in range(i + 1, 30):
            expected = score_by_sampling(scene, SETTINGS, i, j)
            if abs(expected - MIN_OVERLAP) > 0.003:
                assert ((i, j) in pairs) == (expected > MIN_OVERLAP)
            if (i, j) in pairs:
                assert pairs[i, j] == pytest.approx(expected, abs=0.003)


def test_photos_of_a_crowd_keep_their_best(make_scene: Make, random_poses: RandomPoses) -> None:
    scene = make_scene(random_poses(800, 3, (8.0, 2.5, 6.0)))

    pairs = pair_by_frustum(scene, PairSettings(top_k=5))  # scores the 300 nearest of each
    all_scored = pair_by_frustum(scene, PairSettings(top_k=60))  # scores all

    found = {(i, j) for i, j in pairs.rows.tolist()}
    both = np.concatenate([all_scored.rows, all_scored.rows[:, ::-1]])
    scores = np.concatenate([all_scored.scores, all_scored.scores])
    held = 0
    for photo in range(800):
        own = both[:, 0] == photo
        best = both[own, 1][np.argsort(-scores[own], kind="stable")[:5]].tolist()
        held += sum((min(photo, j), max(photo, j)) in found for j in best)
    assert held >= 0.995 * 5 * 800
    assert np.bincount(pairs.rows.ravel(), minlength=800).min() >= 5
    assert (pairs.rows[:, 0] < pairs.rows[:, 1]).all()
    assert (np.diff(pairs.rows @ [800, 1]) > 0).all()


def test_utm_coordinates_change_nothing(make_scene: Make, random_poses: RandomPoses) -> None:
    poses = random_poses(60, 5, (8.0, 2.5, 6.0))
    utm = np.array([448_000.0, 5_411_000.0, 300.0])
    moved = [Pose(p.rotation, -p.rotation @ (p.center + utm)) for p in poses]

    here = pair_by_frustum(make_scene(poses), SETTINGS)
    there = pair_by_frustum(make_scene(moved), SETTINGS)

    assert here.rows.tolist() == there.rows.tolist()
    np.testing.assert_allclose(here.scores, there.scores, atol=1e-6)


def test_each_camera_sees_by_its_own_intrinsics(make_scene: Make, looking: Looking) -> None:
    wide = Camera("PINHOLE", 480, 480, (240.0, 240.0, 240.0, 240.0))
    tele = Camera("PINHOLE", 480, 480, (2400.0, 2400.0, 240.0, 240.0))
    distorted = Camera("SIMPLE_RADIAL", 480, 480, (240.0, 240.0, 240.0, -0.05))
    poses = [looking([0, 0, 0]), looking([0, 0, 0], 30.0)]

    both_wide = pair_by_frustum(make_scene(poses), SETTINGS)
    one_tele = pair_by_frustum(make_scene(poses, cameras=[wide, tele]), SETTINGS)
    both_distorted = pair_by_frustum(make_scene(poses, cameras=[distorted] * 2), SETTINGS)

    assert len(both_wide) == 1
    assert len(one_tele) == 0
    assert 0 < abs(both_distorted.scores[0] - both_wide.scores[0]) < 0.1


def test_photos_without_pose_or_camera_get_no_pair(make_scene: Make, looking: Looking) -> None:
    pose, square = looking([0, 0, 0]), Camera("PINHOLE", 9, 9, (9.0, 9.0, 4.5, 4.5))
    cameras = [square, None, square, square]
    scene = make_scene([pose, pose, None, pose], cameras=cameras)

    assert pair_by_frustum(scene, SETTINGS).rows.tolist() == [[0, 3]]


def test_poses_and_cameras_are_needed(make_scene: Make, looking: Looking) -> None:
    pose = looking([0, 0, 0])
    with pytest.raises(InvalidInput) as no_poses:
        pair_by_frustum(make_scene([pose, None]), SETTINGS)
    with pytest.raises(InvalidInput) as no_cameras:
        pair_by_frustum(make_scene([pose, pose], cameras=[None, None]), SETTINGS)

    assert (no_poses.value.code, no_poses.value.field) == ("pairs.no_poses", "--pairs")
    assert (no_cameras.value.code, no_cameras.value.field) == ("pairs.no_cameras", "--pairs")


def test_a_camera_without_any_ray_is_refused(make_scene: Make, looking: Looking) -> None:
    broken = Camera("PINHOLE", 480, 480, (1e-300, 1e-300, 240.0, 240.0))
    with pytest.raises(InvalidInput) as caught:
        pair_by_frustum(make_scene([looking([0, 0, 0])] * 2, cameras=[broken] * 2), SETTINGS)

    assert (caught.value.code, caught.value.field) == ("pairs.camera", "0.jpg")
