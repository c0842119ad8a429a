from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mapping.frames.anchor import Alignment, align_positions
from mapping.methods.matching.stages import Matches
from mapping.methods.sparse.model import MAPPER_CONFIGS, SfmPhoto, SparseModel
from mapping.methods.sparse.triangulation import (
    ADJUSTMENT,
    LOOK_ALIKES,
    MAPPING,
    TRIANGULATION,
    reconstruct,
    triangulate,
)
from visloc.errors import InvalidInput
from visloc.evaluation import pose_error
from visloc.geometry import Camera, Pose
from visloc.pose.reprojection import project

CAMERA = Camera("OPENCV", 640, 480, (500.0, 510.0, 321.0, 242.0, -0.1, 0.02, 0.001, -0.002))
CONFIG = MAPPER_CONFIGS["config1"]


@dataclass
class World:
    photos: list[SfmPhoto]
    matches: list[Matches]
    points: NDArray[np.float64]

    def truth(self, model: SparseModel) -> NDArray[np.float64]:
        """The true points of the model's points: keypoint k of every photo shows point k."""
        rows = np.zeros(len(model.points), dtype=np.int64)
        rows[model.observations.points] = model.observations.rows
        return self.points[rows]


def look_at(center: NDArray[np.float64], target: NDArray[np.float64]) -> Pose:
    z = (target - center) / np.linalg.norm(target - center)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    return Pose(rotation, -rotation @ center)


def make_world(
    num_photos: int = 8, noise_px: float = 0.0, offset: Sequence[float] = (0, 0, 0)
) -> World:
    random = np.random.default_rng(0)
    points = random.uniform(-2, 2, (300, 3)) + offset
    photos = []
    for number in range(num_photos):
        angle = np.radians(12 * number)
        center = np.array([8 * np.sin(angle), 0.3 * number, -8 * np.cos(angle)]) + offset
        pose = look_at(center, np.array(offset, dtype=np.float64))
        pixels = project(CAMERA, pose.apply(points)) + random.normal(0, noise_px, (300, 2))
        photos.append(
            SfmPhoto(f"{number}.jpg", "cam", number, CAMERA, True, pose, pixels.astype(np.float32))
        )
    every = np.repeat(np.arange(300, dtype=np.uint32)[:, None], 2, axis=1)
    return World(
        photos, [Matches(a, b, every) for a, b in combinations(range(num_photos), 2)], points
    )


def triangulated(*inputs: Any) -> SparseModel:
    return triangulate(*inputs, lambda *_: None)


def test_points_come_back_where_they_were_and_given_poses_stay_as_they_are(tmp_path: Path) -> None:
    world = make_world()
    model = triangulated(world.photos, {}, world.matches, CONFIG, (), tmp_path)
    assert len(model.points) == 300
    np.testing.assert_allclose(model.points, world.truth(model), atol=1e-5)
    for view, photo in zip(model.views, world.photos, strict=True):
        assert view is not None
        assert photo.cam_from_world is not None
        assert np.array_equal(view.cam_from_world.rotation, photo.cam_from_world.rotation)
        assert np.array_equal(view.cam_from_world.translation, photo.cam_from_world.translation)
        assert view.camera == photo.camera
    assert not list(tmp_path.iterdir())


def test_far_from_the_origin_points_are_as_exact(tmp_path: Path) -> None:
    world = make_world(offset=(5e5, 5e6, 100.0))
    model = triangulated(world.photos, {}, world.matches, CONFIG, (), tmp_path)
    np.testing.assert_allclose(model.points, world.truth(model), atol=1e-4)


def test_wrong_matches_make_no_points(tmp_path: Path) -> None:
    world = make_world()
    random = np.random.default_rng(1)
    wrong = [
        replace(
            pair,
            rows=np.column_stack(
                [
                    pair.rows[:, 0],
                    np.where(pair.rows[:, 0] < 60, random.permutation(300), pair.rows[:, 1]),
                ]
            ).astype(np.uint32),
        )
        for pair in world.matches
    ]
    strict = replace(CONFIG, min_track_length=3)  # no verification has dropped anything
    model = triangulated(world.photos, {}, wrong, strict, (), tmp_path)
    errors = np.linalg.norm(model.points - world.truth(model), axis=1)
    assert len(model.points) <= 260
    assert (errors < 1e-3).sum() >= 225


def test_tracks_of_two_photos_are_points_unless_more_are_asked_for(tmp_path: Path) -> None:
    world = make_world(num_photos=2)
    with pytest.raises(InvalidInput, match="too few matches for triangulation"):
        triangulated(
            world.photos, {}, world.matches, replace(CONFIG, min_track_length=3), (), tmp_path
        )
    model = triangulated(world.photos, {}, world.matches, CONFIG, (), tmp_path)
    np.testing.assert_allclose(model.points, world.truth(model), atol=1e-4)
    np.testing.assert_allclose(model.angles_deg, 12, atol=5)


def test_photos_of_one_centre_make_no_points(tmp_path: Path) -> None:
    world = make_world(num_photos=3)
    pose = world.photos[0].cam_from_world
    assert pose is not None
    photos = []
    for number, photo in enumerate(world.photos):
        turn = Rotation.from_euler("z", 10 * number, degrees=True).as_matrix()
        turned = Pose(turn @ pose.rotation, turn @ pose.translation)
        pixels = project(CAMERA, turned.apply(world.points)).astype(np.float32)
        photos.append(replace(photo, cam_from_world=turned, keypoints=pixels))
    with pytest.raises(InvalidInput) as caught:
        triangulated(photos, {}, world.matches, MAPPER_CONFIGS["config2"], (), tmp_path)
    assert caught.value.code == "sfm.no_points"


def test_a_rig_gives_the_same_points_as_its_cameras_alone(tmp_path: Path) -> None:
    world = make_world()
    left = Pose.identity()
    right = Pose(Rotation.from_euler("y", 5, degrees=True).as_matrix(), np.array([-0.4, 0.0, 0.0]))
    rigs: Mapping[str, Mapping[str, Pose]] = {"rig": {"left": left, "right": right}}
    photos = []
    for photo in world.photos[:4]:
        assert photo.cam_from_world is not None
        for sensor, cam_from_rig in rigs["rig"].items():
            pose = cam_from_rig @ photo.cam_from_world
            pixels = project(CAMERA, pose.apply(world.points)).astype(np.float32)
            name = f"{sensor}/{photo.name}"
            photos.append(
                replace(photo, name=name, sensor=sensor, cam_from_world=pose, keypoints=pixels)
            )
    on_rig = triangulated(photos, rigs, world.matches, CONFIG, (), tmp_path)
    alone = triangulated(photos, {}, world.matches, CONFIG, (), tmp_path)
    np.testing.assert_allclose(on_rig.points, world.truth(on_rig), atol=1e-4)
    assert len(on_rig.points) == len(alone.points) == 300


def test_refined_poses_are_better_than_the_noisy_ones_given_and_stay_in_their_frame(
    tmp_path: Path,
) -> None:
    world = make_world(noise_px=0.3)
    random = np.random.default_rng(2)
    noisy = []
    for photo in world.photos:
        assert photo.cam_from_world is not None
        turn = Rotation.from_rotvec(random.normal(0, 0.002, 3)).as_matrix()
        pose = Pose(
            turn @ photo.cam_from_world.rotation,
            photo.cam_from_world.translation + random.normal(0, 0.02, 3),
        )
        noisy.append(replace(photo, cam_from_world=pose))
    model = triangulated(noisy, {}, world.matches, MAPPER_CONFIGS["config2"], ("poses",), tmp_path)

    def errors(poses: Sequence[Pose | None]) -> list[float]:
        truth = [photo.cam_from_world for photo in world.photos]
        return [pose_error(a, b)[1] for a, b in zip(poses, truth, strict=True) if a and b]

    before = errors([photo.cam_from_world for photo in noisy])
    after = errors([view and view.cam_from_world for view in model.views])
    assert np.median(after) < 0.6 * np.median(before)
    distances = [
        float(np.linalg.norm(view.cam_from_world.center - photo.cam_from_world.center))
        for view, photo in zip(model.views, world.photos, strict=True)
        if view and photo.cam_from_world
    ]
    assert max(distances) < 0.05


def test_refined_intrinsics_come_nearer_to_the_truth(tmp_path: Path) -> None:
    world = make_world()
    params = (510.0, 520.0, *CAMERA.params[2:])
    wrong = [replace(photo, camera=replace(CAMERA, params=params)) for photo in world.photos]
    model = triangulated(
        wrong, {}, world.matches, MAPPER_CONFIGS["config2"], ("intrinsics",), tmp_path
    )
    assert model.views[0] is not None
    np.testing.assert_allclose(model.views[0].camera.params[:2], CAMERA.params[:2], rtol=2e-3)
    assert all(view is not None and view.camera == model.views[0].camera for view in model.views)


def test_without_poses_the_same_world_comes_back_up_to_a_similarity(tmp_path: Path) -> None:
    world = make_world()
    photos = [replace(photo, cam_from_world=None) for photo in world.photos]
    told: list[tuple[str, int, int]] = []
    model = reconstruct(
        photos, {}, world.matches, CONFIG, (), tmp_path, lambda *now: told.append(now)
    )
    for stage in (LOOK_ALIKES, MAPPING, ADJUSTMENT):
        told_of_it = [(done, total) for each, done, total in told if each == stage]
        assert told_of_it == sorted(told_of_it)
        total = told_of_it[-1][1]
        assert told_of_it.count((total, total)) == 1
    # Every photo is a sign of progress of its own, and the end is told once.
    triangulated_now = [(done, total) for stage, done, total in told if stage == TRIANGULATION]
    total = triangulated_now[0][1]
    assert {(done, total) for done in range(len(photos) + 1)} <= set(triangulated_now)
    assert triangulated_now == sorted(triangulated_now)
    assert triangulated_now.count((total, total)) == 1
    assert all(view is not None for view in model.views)
    centers = np.array([view.cam_from_world.center for view in model.views if view])
    known = np.array([p.cam_from_world.center for p in world.photos if p.cam_from_world])
    found = align_positions(centers, known, 0.1)
    assert isinstance(found, Alignment), found
    similarity, agrees = found
    assert agrees.all()
    np.testing.assert_allclose(similarity.apply(model.points), world.truth(model), atol=1e-3)
    for view, photo in zip(model.views, world.photos, strict=True):
        assert view is not None
        assert photo.cam_from_world is not None
        moved = similarity.move(view.cam_from_world)
        position, angle = pose_error(moved, photo.cam_from_world)
        assert position < 1e-3
        assert angle < 1e-2
        assert view.camera == CAMERA


def at(x: float, yaw_deg: float = 0.0) -> Pose:
    """cam_from_rig of a camera at (x, 0, 0) that looks to one side."""
    rotation = Rotation.from_euler("y", yaw_deg, degrees=True).as_matrix()
    return Pose(rotation, -rotation @ [x, 0.0, 0.0])


def seen_by(world: World, members: Mapping[str, Pose], camera: Camera) -> list[SfmPhoto]:
    """Photos by each camera of a rig, in order, with half a pixel of noise."""
    random = np.random.default_rng(3)
    photos = []
    for photo in world.photos:
        assert photo.cam_from_world is not None
        for sensor, cam_from_rig in members.items():
            pose = cam_from_rig @ photo.cam_from_world
            pixels = project(camera, pose.apply(world.points))
            pixels += random.normal(0, 0.5, pixels.shape)
            changes = {"sensor": sensor, "camera": camera, "cam_from_world": pose}
            name, keypoints = f"{sensor}/{photo.name}", pixels.astype(np.float32)
            photos.append(replace(photo, name=name, keypoints=keypoints, **changes))
    return photos


SIMPLE = Camera("SIMPLE_PINHOLE", 640, 480, (500.0, 320.0, 240.0))


@pytest.mark.parametrize(
    ("members", "left_out", "guess"),
    [
        ({"left": at(0), "right": at(0.1, 2)}, (), None),
        ({"left": at(0), "right": at(1, -3)}, (), None),
        ({"left": at(-0.3), "right": at(0)}, (), None),
        ({"a": at(-0.4), "b": at(0, 3), "c": at(0.5)}, (), None),
        ({"left": at(0), "right": at(0.4)}, (1, 5, 7, 8), None),
        ({"left": at(0), "right": at(0.4)}, (), 600.0),
    ],
    ids=["10 cm", "1 m", "right is the rig", "three", "instants of one camera", "unknown lens"],
)
def test_estimated_models_have_the_unit_and_the_distances_of_their_rig(
    tmp_path: Path, members: dict[str, Pose], left_out: tuple[int, ...], guess: float | None
) -> None:
    world = make_world(num_photos=6)
    taken = [p for row, p in enumerate(seen_by(world, members, SIMPLE)) if row not in left_out]
    camera = SIMPLE if guess is None else replace(SIMPLE, params=(guess, 320.0, 240.0))
    photos = [
        replace(p, cam_from_world=None, camera=camera, camera_known=guess is None) for p in taken
    ]
    rows = world.matches[0].rows
    matches = [Matches(a, b, rows) for a, b in combinations(range(len(photos)), 2)]
    model = reconstruct(photos, {"rig": members}, matches, CONFIG, (), tmp_path, lambda *_: None)
    placed = {p.name: v.cam_from_world for p, v in zip(photos, model.views, strict=True) if v}
    assert len(placed) == len(photos)
    first, *others = members
    for name, pose in placed.items():
        for other in others:
            if name.startswith(first) and (beside := placed.get(name.replace(first, other, 1))):
                found, known = beside @ pose.inverse(), members[other] @ members[first].inverse()
                np.testing.assert_allclose(
                    found.translation, known.translation, rtol=1e-6, atol=1e-9
                )
                np.testing.assert_allclose(found.rotation, known.rotation, atol=1e-9)
    centers = np.array([placed[photo.name].center for photo in taken])
    known_centers = np.array([p.cam_from_world.center for p in taken if p.cam_from_world])
    aligned = align_positions(centers, known_centers, 0.2)
    assert isinstance(aligned, Alignment), aligned
    assert aligned.similarity.scale == pytest.approx(1.0, abs=0.01)


def test_cameras_of_a_rig_at_one_place_leave_the_unit_open(tmp_path: Path) -> None:
    world, members = make_world(num_photos=4), {"left": at(0), "right": at(0, 3)}
    photos = [replace(p, cam_from_world=None) for p in seen_by(world, members, SIMPLE)]
    rows = world.matches[0].rows
    matches = [Matches(a, b, rows) for a, b in combinations(range(len(photos)), 2)]
    model = reconstruct(photos, {"rig": members}, matches, CONFIG, (), tmp_path, lambda *_: None)
    poses = [view.cam_from_world for view in model.views if view]
    assert len(poses) == len(photos)
    for left, right in zip(poses[::2], poses[1::2], strict=True):
        np.testing.assert_allclose(left.center, right.center, atol=1e-9)


def test_photos_that_share_nothing_cannot_be_placed(tmp_path: Path) -> None:
    world = make_world(num_photos=3)
    photos = [replace(photo, cam_from_world=None) for photo in world.photos]
    with pytest.raises(InvalidInput) as caught:
        reconstruct(photos, {}, [], CONFIG, (), tmp_path, lambda *_: None)
    assert caught.value.code == "sfm.no_matches"
