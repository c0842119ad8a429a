from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from samples.render import render_depth, render_photo
from samples.scene import Rectangle, Scene, picture_levels
from samples.trajectories import mapping_trajectory
from visloc.errors import InvalidInput
from visloc.geometry import Camera, Pose

CAMERA = Camera("PINHOLE", 160, 120, (113.0, 116.0, 82.3, 57.9))
# About x, y and z at once, so that no axis can be mixed up unnoticed.
TILTED = Pose.from_quaternion([0.9, 0.12, -0.2, 0.08], [0.1, -0.2, 2.0])


def plane(picture: NDArray[np.uint8], width_m: float = 4.0, height_m: float = 3.0) -> Rectangle:
    """A picture in the world's x-y plane around the origin, upright for a camera along +z."""
    return Rectangle(
        np.array([-width_m / 2, -height_m / 2, 0.0]),
        np.array([width_m, 0.0, 0.0]),
        np.array([0.0, height_m, 0.0]),
        picture_levels(picture),
    )


def rays(camera: Camera) -> NDArray[np.float64]:
    """Directions (H, W, 3) with z = 1 through the pixel centres."""
    fx, fy, cx, cy = camera.params
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)], axis=-1)


def project(camera: Camera, points: NDArray[np.float64]) -> NDArray[np.float64]:
    fx, fy, cx, cy = camera.params
    xy = points[..., :2] / points[..., 2:]
    return np.asarray(xy * (fx, fy) + (cx, cy))


def distance_to(rectangle: Rectangle, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance (N,) of points (N, 3) to a rectangle."""
    offset = points - rectangle.corner
    shares = [
        np.clip(offset @ edge / (edge @ edge), 0, 1)[:, None] * edge
        for edge in (rectangle.edge_u, rectangle.edge_v)
    ]
    return np.asarray(np.linalg.norm(offset - shares[0] - shares[1], axis=1))


def traced_depth(scene: Scene, origin: NDArray[np.float64], ray: NDArray[np.float64]) -> float:
    """Depth along one ray, by solving origin + z ray = corner + u edge_u + v edge_v for each."""
    nearest = np.inf
    for each in scene.rectangles:
        system = np.column_stack([ray, -each.edge_u, -each.edge_v])
        z, u, v = np.linalg.solve(system, each.corner - origin)
        if z > 0 and 0 <= u <= 1 and 0 <= v <= 1:
            nearest = min(nearest, z)
    return nearest


@pytest.mark.parametrize("instant", [0, 7, 16])
def test_depth_lies_on_the_scene_and_nothing_is_nearer(room: Scene, instant: int) -> None:
    pose = mapping_trajectory(30)[instant]
    world_from_cam = pose.inverse()
    depth = render_depth(room, CAMERA, pose)
    assert depth.shape == (120, 160)
    assert depth.min() > 0.3
    points = world_from_cam.apply(rays(CAMERA) * depth[..., None]).reshape(-1, 3)
    distance = np.min([distance_to(each, points) for each in room.rectangles], axis=0)
    assert distance.max() < 1e-6

    rng = np.random.default_rng(1)
    for row, column in rng.integers((0, 0), (120, 160), (40, 2)):
        ray = world_from_cam.rotation @ rays(CAMERA)[row, column]
        expected = traced_depth(room, pose.center, ray)
        assert depth[row, column] == pytest.approx(expected, abs=1e-6)


def test_depth_is_along_the_optical_axis_not_along_the_ray() -> None:
    wall = plane(np.full((300, 400, 3), 128, np.uint8), 40.0, 30.0)
    depth = render_depth(Scene((wall,)), CAMERA, Pose(np.eye(3), np.array([0.0, 0.0, 2.5])))
    np.testing.assert_allclose(depth, 2.5, atol=1e-12)


def test_where_nothing_is_depth_is_zero_and_the_photo_black() -> None:
    wall = plane(np.full((300, 400, 3), 128, np.uint8))
    behind = Pose(np.eye(3), np.array([0.0, 0.0, -2.0]))
    assert not render_depth(Scene((wall,)), CAMERA, behind).any()
    assert not render_photo(Scene((wall,)), CAMERA, behind).any()


def test_marks_appear_where_they_project_to() -> None:
    # Discs painted at known places of a tilted plane; the centroid of each blob must be its
    # projection, but for the perspective of the disc itself, 0.02 px here.
    texels_per_m = 400
    height, width = 3 * texels_per_m, 4 * texels_per_m
    y, x = np.mgrid[0:height, 0:width] + 0.5
    for u, v in ((0.3, 0.35), (0.7, 0.4), (0.5, 0.5), (0.35, 0.68), (0.66, 0.7)):
        inside = 0.04 * texels_per_m - np.hypot(x - u * width, y - v * height)
        disc = (250 * np.clip(inside + 0.5, 0, 1)).astype(np.uint8)
        wall = plane(disc[..., None].repeat(3, axis=2))
        photo = render_photo(Scene((wall,)), CAMERA, TILTED)[..., 1].astype(float)
        rows, columns = np.mgrid[0:120, 0:160] + 0.5
        centroid = np.array([(photo * columns).sum(), (photo * rows).sum()]) / photo.sum()
        expected = project(CAMERA, TILTED.apply(wall.at(u, v)))
        np.testing.assert_allclose(centroid, expected, atol=0.03)


def test_the_edge_of_a_rectangle_lies_between_the_right_pixels() -> None:
    wall = plane(np.full((300, 400, 3), 200, np.uint8))
    camera = Camera("PINHOLE", 160, 120, (100.0, 100.0, 80.0, 60.0))
    # x from -2 to 2 at 5 m: pixels 40 to 120 exactly.
    photo = render_photo(Scene((wall,)), camera, Pose(np.eye(3), np.array([0.0, 0.0, 5.0])))
    lit = np.flatnonzero(photo[60, :, 0])
    assert (lit.min(), lit.max()) == (40, 119)


def test_detail_finer_than_a_pixel_becomes_its_mean_instead_of_shimmer() -> None:
    fine = (np.indices((3000, 4000)).sum(axis=0) % 2 * 200).astype(np.uint8)
    wall = plane(fine[..., None].repeat(3, axis=2), 8.0, 6.0)
    photo = render_photo(Scene((wall,)), CAMERA, Pose(np.eye(3), np.array([0.0, 0.0, 3.0])))
    centre = photo[50:70, 70:90, 0].astype(float)
    assert centre.mean() == pytest.approx(100, abs=3)
    assert centre.std() < 1.5


def test_two_views_agree_through_depth(room: Scene) -> None:
    camera = Camera("PINHOLE", 320, 240, (229.0, 229.0, 160.0, 120.0))
    poses = mapping_trajectory(60)
    here, there = poses[20], poses[21]
    photos = [render_photo(room, camera, p).mean(axis=2) for p in (here, there)]
    depths = [render_depth(room, camera, p) for p in (here, there)]
    moved = (there @ here.inverse()).apply(rays(camera) * depths[0][..., None]).reshape(-1, 3)
    moved_px = project(camera, moved)
    columns, rows = np.floor(moved_px).astype(int).T
    visible = (moved[:, 2] > 0) & (columns >= 0) & (columns < 320) & (rows >= 0) & (rows < 240)
    seen = np.flatnonzero(visible)
    seen = seen[np.abs(depths[1][rows[seen], columns[seen]] - moved[seen, 2]) < 0.02]
    # Nearest pixels only, so that half a pixel of texture remains as a difference; shifting one
    # photo by two pixels must be much worse.
    difference = np.abs(photos[0].ravel()[seen] - photos[1][rows[seen], columns[seen]])
    off = np.abs(photos[0].ravel()[seen] - np.roll(photos[1], 2, axis=1)[rows[seen], columns[seen]])
    assert len(seen) > 0.3 * 320 * 240
    assert np.median(difference) < 10
    assert np.median(difference) < 0.5 * np.median(off)


def test_noise_comes_from_the_given_generator_only(room: Scene) -> None:
    pose = mapping_trajectory(30)[3]
    photos = [
        render_photo(room, CAMERA, pose, seed if seed is None else np.random.default_rng(seed))
        for seed in (None, None, 5, 5, 6)
    ]
    np.testing.assert_array_equal(photos[0], photos[1])
    np.testing.assert_array_equal(photos[2], photos[3])
    assert (photos[2] != photos[4]).any()
    assert np.abs(photos[2].astype(int) - photos[0]).mean() < 2


@pytest.mark.parametrize("render", [render_photo, render_depth])
def test_other_camera_models_are_refused(render: object) -> None:
    camera = Camera("SIMPLE_PINHOLE", 160, 120, (113.0, 80.0, 60.0))
    with pytest.raises(InvalidInput) as raised:
        render(Scene(()), camera, Pose.identity())  # type: ignore[operator]
    assert raised.value.code == "camera.model"
