from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from samples import surfaces
from samples.render import render_depth, render_photo
from samples.scene import ROOM_SIZE_M, Scene, make_room
from samples.trajectories import mapping_trajectory, query_trajectory, stereo_rig
from visloc.geometry import Camera, Pose


def sift(photo: NDArray[np.uint8]) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Keypoints (N, 2) in pixels, top-left centre (0.5, 0.5), and descriptors (N, 128)."""
    detector = cv2.SIFT.create(enable_precise_upscale=True)
    found, descriptors = detector.detectAndCompute(cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY), None)
    keypoints = np.array([k.pt for k in found], dtype=np.float64) + 0.5
    return keypoints, np.asarray(descriptors, dtype=np.float32)


def test_the_same_seed_paints_the_same_room_and_another_seed_another(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(surfaces, "TEXELS_PER_M", 100)  # coarse, and painted in no time
    room, again, other = make_room(0), make_room(0), make_room(1)
    for first, second in zip(room.rectangles, again.rectangles, strict=True):
        np.testing.assert_array_equal(first.levels[0], second.levels[0])
    for first, second in zip(room.rectangles, other.rectangles, strict=True):
        np.testing.assert_array_equal(first.corner, second.corner)
        assert (first.levels[0] != second.levels[0]).mean() > 0.05


def test_rectangles_have_right_angles_and_square_texels(room: Scene) -> None:
    for each in room.rectangles:
        assert each.edge_u @ each.edge_v == pytest.approx(0, abs=1e-12)
        height, width = each.levels[0].shape[:2]
        ratio = np.linalg.norm(each.edge_u) / width / (np.linalg.norm(each.edge_v) / height)
        assert ratio == pytest.approx(1, abs=0.05)


def test_everything_lies_in_the_room(room: Scene) -> None:
    corners = np.array([r.at(u, v) for r in room.rectangles for u in (0, 1) for v in (0, 1)])
    bound = np.array(ROOM_SIZE_M) / (2, 2, 1) + 1e-9
    assert (np.abs(corners[:, :2]) <= bound[:2]).all()
    assert (corners[:, 2] >= -1e-9).all()
    assert (corners[:, 2] <= bound[2]).all()


def test_the_room_has_no_cracks(room: Scene) -> None:
    camera = Camera("PINHOLE", 200, 200, (60.0, 60.0, 100.0, 100.0))
    rng = np.random.default_rng(3)
    for _ in range(12):
        rotation = Pose.from_quaternion(rng.normal(size=4), np.zeros(3)).rotation
        center = rng.uniform((-1.3, -0.8, 1.2), (1.3, 0.8, 1.8))
        pose = Pose(rotation, -rotation @ center)
        assert (render_depth(room, camera, pose) > 0).all()
        assert (render_photo(room, camera, pose).max(axis=2) > 0).all()


def test_every_photo_is_rich_in_keypoints(room: Scene) -> None:
    left = stereo_rig(640, 480)["left"]
    for rig_from_world in [*mapping_trajectory(30)[::4], *query_trajectory(10, 30)[::2]]:
        noise = np.random.default_rng(0)
        photo = render_photo(room, left.camera, left.cam_from_rig @ rig_from_world, noise)
        keypoints, _ = sift(photo)
        assert len(keypoints) > 800
        columns, rows = (keypoints // 80).astype(int).T
        cells = np.bincount(rows * 8 + columns, minlength=48)
        assert (cells > 3).all()  # everywhere, not in a few spots only


@pytest.mark.parametrize("instant", [2, 15, 28])
def test_matches_of_consecutive_photos_meet_through_depth(room: Scene, instant: int) -> None:
    left = stereo_rig(640, 480)["left"]
    fx, fy, cx, cy = left.camera.params
    poses = [left.cam_from_rig @ p for p in mapping_trajectory(30)[instant - 1 : instant + 1]]
    noise = np.random.default_rng(0)
    features = [sift(render_photo(room, left.camera, pose, noise)) for pose in poses]
    similarity = [d / np.linalg.norm(d, axis=1, keepdims=True) for _, d in features]
    scores = similarity[0] @ similarity[1].T
    best = scores.argmax(axis=1)
    mutual = np.flatnonzero(
        (scores.argmax(axis=0)[best] == np.arange(len(best))) & (scores.max(axis=1) > 0.85)
    )
    here, there = features[0][0][mutual], features[1][0][best[mutual]]
    depth = render_depth(room, left.camera, poses[0])
    z = depth[here[:, 1].astype(int), here[:, 0].astype(int)]
    points = np.column_stack([(here[:, 0] - cx) / fx * z, (here[:, 1] - cy) / fy * z, z])
    moved = (poses[1] @ poses[0].inverse()).apply(points)
    expected = moved[:, :2] / moved[:, 2:] * (fx, fy) + (cx, cy)
    errors = np.linalg.norm(expected - there, axis=1)
    assert len(errors) > 300
    assert np.median(errors) < 0.5
    # No common shift: half a pixel anywhere in renderer or depth would show here.
    close = errors < 2
    assert np.abs(np.median((expected - there)[close], axis=0)).max() < 0.1
