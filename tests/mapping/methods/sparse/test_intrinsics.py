from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import PIL.Image  # noqa: F401  before pycolmap, see visloc.pose.reprojection
import pycolmap
import pytest
from numpy.typing import NDArray

from mapping.methods.matching.stages import Matches
from mapping.methods.sparse.colmap_scene import colmap_database
from mapping.methods.sparse.intrinsics import CameraOrigin, Doubt, is_plausible, notes_on, origin_of
from mapping.methods.sparse.model import MAPPER_CONFIGS, SfmPhoto, SparseModel
from mapping.methods.sparse.triangulation import (
    MAPPING,
    reconstruct,
    solve_with_priors,
    triangulate,
)
from visloc.errors import InvalidInput
from visloc.geometry import Camera, Pose
from visloc.kapture import Sensor
from visloc.pose.reprojection import project

CONFIG = MAPPER_CONFIGS["config1"]
WIDTH, HEIGHT, FOCAL = 800, 600, 700.0
NOISE_PX = 0.3


def camera(focal: float, k: float = 0.0) -> Camera:
    return Camera("SIMPLE_RADIAL", WIDTH, HEIGHT, (focal, WIDTH / 2, HEIGHT / 2, k))


def looking(center: Sequence[float], target: Sequence[float], up: Sequence[float]) -> Pose:
    z = np.subtract(target, center)
    z /= np.linalg.norm(z)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    return Pose(rotation, -rotation @ np.array(center))


def taken(
    points: NDArray[np.float64],
    poses: Sequence[Pose],
    lens: Camera,
    prior: Camera | None,
    sensor: str = "cam",
    radius: float = np.inf,
) -> tuple[list[SfmPhoto], list[NDArray[np.int64]]]:
    """Photos of points (P, 3) as a lens takes them, and which points each shows.

    Args:
        points: of the scene.
        poses: of the photos.
        lens: what they are taken with.
        prior: what is known of it; None for nothing.
        sensor: id of the camera.
        radius: what is further from the middle of the photo is not seen, pixels.
    """
    random = np.random.default_rng(3)
    photos, shown = [], []
    for number, pose in enumerate(poses):
        pixels = project(lens, pose.apply(points))
        away = np.linalg.norm(pixels - (WIDTH / 2, HEIGHT / 2), axis=1)
        seen = ((pixels >= 0) & (pixels < (WIDTH, HEIGHT))).all(axis=1) & (away < radius)
        ids = np.flatnonzero(seen)
        noisy = pixels[ids] + random.normal(0, NOISE_PX, (len(ids), 2))
        guess = camera(1.2 * WIDTH) if prior is None else prior
        name = f"{sensor}/{number}.jpg"
        photo = SfmPhoto(
            name, sensor, number, guess, prior is not None, pose, noisy.astype(np.float32)
        )
        photos.append(photo)
        shown.append(ids)
    return photos, shown


def matched(shown: Sequence[NDArray[np.int64]]) -> list[Matches]:
    matches = []
    for a, b in combinations(range(len(shown)), 2):
        _, rows_a, rows_b = np.intersect1d(shown[a], shown[b], return_indices=True)
        if len(rows_a) >= CONFIG.min_num_matches:
            matches.append(Matches(a, b, np.column_stack([rows_a, rows_b]).astype(np.uint32)))
    return matches


def around_an_object() -> tuple[NDArray[np.float64], list[Pose]]:
    points = np.random.default_rng(0).uniform(-2.5, 2.5, (300, 3))
    return points, [
        looking((8 * np.sin(a), -8 * np.cos(a), np.sin(3 * a)), (0, 0, 0), (0, 0, 1))
        for a in np.radians(14 * np.arange(8))
    ]


def quiet(_stage: str, _done: int, _total: int) -> None:
    pass


def above_flat_ground(relief: float = 0.2) -> tuple[NDArray[np.float64], list[Pose]]:
    """A drone 40 m above a beach, in three lines, held level within two degrees."""
    random = np.random.default_rng(0)
    points = np.column_stack([random.uniform(-60, 60, (1500, 2)), random.normal(0, relief, 1500)])
    poses = []
    for line in range(3):
        for step in range(4):
            center = np.array([22.0 * step - 33, 15.0 * line - 15, 40 + random.normal(0, 0.5)])
            tilt = np.append(np.tan(np.radians(random.normal(0, 2, 2))), -1.0)
            poses.append(looking(center, center + tilt, (0, 1 - 2 * (line % 2), 0)))
    return points, poses


def solved(
    scene: tuple[NDArray[np.float64], list[Pose]],
    prior: Camera | None,
    work: Path,
    lens: Camera | None = None,
    radius: float = np.inf,
) -> SparseModel:
    photos, shown = taken(*scene, lens or camera(FOCAL), prior, radius=radius)
    return reconstruct(photos, {}, matched(shown), CONFIG, ("intrinsics",), work, quiet)


def cameras_in(model: SparseModel) -> set[Camera]:
    return {view.camera for view in model.views if view is not None}


@pytest.mark.parametrize("off", [0.95, 1.05])
def test_a_prior_five_per_cent_off_is_corrected_where_the_photos_tell(
    off: float, tmp_path: Path
) -> None:
    model = solved(around_an_object(), camera(off * FOCAL), tmp_path)
    (found,) = cameras_in(model)
    assert found.focal_length == pytest.approx(FOCAL, rel=0.01)
    assert not model.doubts
    assert all(view is not None for view in model.views)


def test_flat_ground_from_above_leaves_the_focal_length_as_it_was(tmp_path: Path) -> None:
    prior = camera(1.04 * FOCAL)
    model = solved(above_flat_ground(), prior, tmp_path)
    assert cameras_in(model) == {prior}
    assert model.doubts["cam"].reason == "undetermined"
    assert sum(view is not None for view in model.views) == 12
    # As high above the ground as the prior says, for the distances between the photos.
    _, poses = above_flat_ground()
    centers = np.array([view.cam_from_world.center for view in model.views if view])
    true = np.array([pose.center for pose in poses])
    unit = np.linalg.norm(true[3] - true[0]) / np.linalg.norm(centers[3] - centers[0])
    normal = np.linalg.svd(model.points - model.points.mean(axis=0))[2][2]
    heights = unit * np.abs((centers - model.points.mean(axis=0)) @ normal)
    assert np.median(heights) == pytest.approx(1.04 * 40, rel=0.01)


def test_the_verdict_is_the_same_in_small_and_large_photos(tmp_path: Path) -> None:
    photos, shown = taken(*above_flat_ground(relief=1.0), camera(FOCAL), camera(FOCAL))
    for scale in (1, 4):  # the errors rise by 0.04 and 0.15 px
        width, height = scale * WIDTH, scale * HEIGHT
        prior = Camera("SIMPLE_RADIAL", width, height, (scale * FOCAL, width / 2, height / 2, 0.0))
        scaled = [
            replace(photo, camera=prior, keypoints=photo.keypoints * np.float32(scale))
            for photo in photos
        ]
        model = reconstruct(scaled, {}, matched(shown), CONFIG, ("intrinsics",), tmp_path, quiet)
        assert model.doubts["cam"].reason == "undetermined"


def test_without_a_prior_flat_ground_gives_a_map_and_a_doubt(tmp_path: Path) -> None:
    model = solved(above_flat_ground(), None, tmp_path)
    assert model.doubts["cam"].reason == "undetermined"
    (found,) = cameras_in(model)
    assert found.focal_length == model.doubts["cam"].focal_length_px


def test_without_a_prior_the_focal_length_is_found_where_the_photos_tell(tmp_path: Path) -> None:
    model = solved(around_an_object(), None, tmp_path)
    (found,) = cameras_in(model)
    assert found.focal_length == pytest.approx(FOCAL, rel=0.01)
    assert not model.doubts


def test_a_prior_fifteen_per_cent_off_stays_and_the_doubt_has_what_the_photos_say(
    tmp_path: Path,
) -> None:
    prior = camera(1.15 * FOCAL)
    model = solved(around_an_object(), prior, tmp_path)
    assert cameras_in(model) == {prior}
    assert model.doubts["cam"].reason == "moved"
    assert model.doubts["cam"].focal_length_px == pytest.approx(FOCAL, rel=0.02)


def test_with_given_poses_the_same_holds(tmp_path: Path) -> None:
    for off, reason in ((1.03, None), (1.15, "moved")):
        photos, shown = taken(*around_an_object(), camera(FOCAL), camera(off * FOCAL))
        wide = MAPPER_CONFIGS["config2"]
        model = triangulate(
            photos, {}, matched(shown), wide, ("intrinsics",), tmp_path, lambda *_: None
        )
        (found,) = cameras_in(model)
        expected = FOCAL if reason is None else off * FOCAL
        assert found.focal_length == pytest.approx(expected, rel=0.01)
        assert [doubt.reason for doubt in model.doubts.values()] == [reason] * (reason is not None)


# Its rays turn back half-way to the corners: no lens does that.
NONSENSE = camera(FOCAL, -0.9)


def test_photos_of_a_camera_that_no_lens_has_are_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput) as caught:
        solved(around_an_object(), None, tmp_path, NONSENSE, radius=230)
    assert caught.value.code == "sfm.camera"
    assert caught.value.field == "cam/0.jpg, cam/1.jpg, cam/2.jpg, ..."
    assert "not plausible for any lens" in caught.value.message
    assert "import photos with --output first" in str(caught.value.expected)


def test_with_a_prior_a_camera_that_no_lens_has_stays_at_it(tmp_path: Path) -> None:
    model = solved(around_an_object(), camera(FOCAL), tmp_path, NONSENSE, radius=230)
    assert cameras_in(model) == {camera(FOCAL)}
    assert model.doubts["cam"].reason == "implausible"


def test_of_several_cameras_only_the_photos_of_nonsense_are_left_out(tmp_path: Path) -> None:
    points, poses = around_an_object()
    good, shown = taken(points, poses[:6], camera(FOCAL), camera(FOCAL))
    bad, shown_badly = taken(points, poses[6:], NONSENSE, None, "odd", radius=230)
    model = reconstruct(
        [*good, *bad], {}, matched([*shown, *shown_badly]), CONFIG, ("intrinsics",), tmp_path, quiet
    )
    assert [view is not None for view in model.views] == [True] * 6 + [False] * 2
    assert model.doubts.keys() == {"odd"}


def test_the_first_pair_of_two_photos_is_not_yet_all(tmp_path: Path) -> None:
    points, poses = around_an_object()
    photos, shown = taken(points, poses[:4:3], camera(FOCAL), camera(FOCAL))
    told: list[tuple[int, int]] = []

    def tell(stage: str, done: int, total: int) -> None:
        if stage == MAPPING:
            told.append((done, total))

    reconstruct(photos, {}, matched(shown), CONFIG, (), tmp_path, tell)
    total = told[-1][1]
    assert told[0] == (2, total)
    assert told.index((total, total)) == len(told) - 1


def test_the_same_photos_give_the_same_bits(tmp_path: Path) -> None:
    # So many that pycolmap would otherwise add up their errors in several threads.
    points = np.random.default_rng(0).uniform(-2.5, 2.5, (3300, 3))
    scene = points, around_an_object()[1]
    photos, shown = taken(*scene, camera(FOCAL), camera(FOCAL))
    models = [
        reconstruct(photos, {}, matched(shown), CONFIG, (), tmp_path, quiet) for _ in range(2)
    ]
    assert np.array_equal(models[0].points, models[1].points)


def test_cameras_that_come_in_doubt_one_after_another_are_solved_so_often(tmp_path: Path) -> None:
    # Six cameras with a prior, two without. Each model has photos of one of them that is not in
    # doubt yet, and determines nothing; of those without a prior it makes what no lens has.
    points, poses = around_an_object()
    photos, shown = [], []
    for number, pose in enumerate(poses):
        prior = camera(FOCAL) if number < 6 else None
        taken_here, shown_here = taken(points, [pose], camera(FOCAL), prior, f"{number}")
        photos += taken_here
        shown += shown_here
    asked: list[set[str]] = []
    with colmap_database(photos, {}, matched(shown), tmp_path) as (_, scene):

        def solve(doubts: dict[str, Doubt]) -> pycolmap.Reconstruction:
            asked.append(set(doubts))
            model = scene.with_poses(photos)
            left = [
                image
                for image, p in zip(scene.images, photos, strict=True)
                if p.sensor not in doubts
            ]
            for image in scene.images:
                if not left or image.image_id != left[0].image_id:
                    model.deregister_frame(image.frame_id)
            for sensor in ("6", "7"):
                model.camera(scene.camera_ids[sensor]).params = NONSENSE.params
            return model

        _, doubts = solve_with_priors(solve, scene, photos, set(scene.cameras), poses=True)
    with_prior = {"0", "1", "2", "3", "4", "5"}
    assert [len(doubted) for doubted in asked] == [0, 1, 2, 6, 7, 8]
    assert asked[3] == with_prior
    reasons = [doubts[f"{number}"].reason for number in range(8)]
    assert reasons == ["undetermined"] * 3 + ["unsettled"] * 3 + ["implausible"] * 2


@pytest.mark.parametrize(
    ("model", "params", "expected"),
    [
        ("SIMPLE_RADIAL", (11579.8, 512, 384, -50.96), False),
        ("SIMPLE_RADIAL", (17048.6, 512, 384, 0.0), False),
        ("SIMPLE_RADIAL", (-616.2, 512, 384, 0.0), False),
        ("SIMPLE_RADIAL", (float("nan"), 512, 384, 0.0), False),
        ("SIMPLE_RADIAL", (200, 512, 384, 0.0), False),
        ("SIMPLE_RADIAL", (800, 512, 384, -0.9), False),
        ("SIMPLE_RADIAL", (800, 512, 384, 4.0), False),
        ("SIMPLE_RADIAL", (2653, 512, 384, 0.13), True),
        ("SIMPLE_RADIAL", (560, 512, 384, -0.2), True),  # an action camera
        ("OPENCV", (800, 810, 500, 390, -0.1, 0.02, 0.001, -0.002), True),
        ("OPENCV_FISHEYE", (300, 300, 512, 384, 0, 0, 0, 0), True),
    ],
)
def test_what_a_lens_may_have(model: str, params: tuple[float, ...], expected: bool) -> None:
    made = pycolmap.Camera(model=model, width=1024, height=768, params=list(params))
    assert is_plausible(made) is expected


def test_notes_name_cameras_values_and_what_to_do() -> None:
    exif = Sensor.with_camera("drone", camera(848.6), name="DJI FC220 (EXIF)")
    given = Sensor.with_camera("cam", camera(700.0))
    unknown = replace(given, id="old", camera=None)
    origins = {
        "drone": origin_of(exif, Doubt("undetermined", 1083.7)),
        "cam": origin_of(given, Doubt("moved", 805.0)),
        "old": origin_of(unknown, Doubt("implausible", float("nan"))),
        "fine": origin_of(given, None),
    }
    assert origins["old"].refined_px is None
    photos = {"drone": ["a", "b"], "cam": ["c"], "old": ["d.jpg"], "fine": ["e"]}
    undetermined, moved, left_out = notes_on(origins, photos)
    assert "848.6 px of EXIF, 1083.7 px by the photos (+27.7%)" in undetermined
    assert "such as oblique ones" in undetermined
    assert "1 camera of 2 photos" in undetermined
    assert "700.0 px of the dataset, 805.0 px by the photos (+15.0%)" in moved
    assert "d.jpg" in left_out
    for note in (undetermined, moved, left_out):
        assert "import photos with --output first" in note
    for origin in origins.values():
        assert CameraOrigin.model_validate(origin.model_dump()) == origin


def around_an_object_in_many_photos() -> tuple[NDArray[np.float64], list[Pose]]:
    points, _ = around_an_object()
    return points, [
        looking((8 * np.sin(a), -8 * np.cos(a), 2 * np.sin(3 * a)), (0, 0, 0), (0, 0, 1))
        for a in np.radians(5 * np.arange(32))
    ]


def test_many_photos_tell_where_the_principal_point_is(tmp_path: Path) -> None:
    x, y = WIDTH / 2 + 0.006 * WIDTH, HEIGHT / 2 - 0.004 * WIDTH
    lens = Camera("SIMPLE_RADIAL", WIDTH, HEIGHT, (FOCAL, x, y, 0.0))
    model = solved(around_an_object_in_many_photos(), None, tmp_path, lens)
    (found,) = cameras_in(model)
    np.testing.assert_allclose(found.params[1:3], (x, y), atol=0.001 * WIDTH)


def test_a_principal_point_that_no_lens_has_is_not_taken(tmp_path: Path) -> None:
    x = WIDTH / 2 + 0.05 * WIDTH
    lens = Camera("SIMPLE_RADIAL", WIDTH, HEIGHT, (FOCAL, x, HEIGHT / 2, 0.0))
    model = solved(around_an_object_in_many_photos(), None, tmp_path, lens)
    (found,) = cameras_in(model)
    assert found.params[1:3] == (WIDTH / 2, HEIGHT / 2)
