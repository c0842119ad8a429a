from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mapping.frames.anchor import (
    Alignment,
    about_rows,
    align_poses,
    align_positions,
    at_own_scale,
    known_positions,
    scale_doubt,
    spread_of,
)
from mapping.stages.photos import MappingPhoto
from visloc.archive.places import origin_of
from visloc.errors import DatasetError, InvalidInput
from visloc.evaluation import pose_error
from visloc.geodesy import (
    ecef_from_geodetic,
    enu_from_ecef,
    enu_from_geodetic,
    geodetic_from_enu,
)
from visloc.geometry import Camera, Pose, Similarity
from visloc.kapture import Dataset, FileRecord, GnssRecord, Sensor

RANDOM = np.random.default_rng(0)
TRUE = Similarity(
    2.5, Rotation.from_rotvec([0.3, -1.0, 0.2]).as_matrix(), np.array([10.0, -4.0, 2.0])
)
CENTERS = RANDOM.uniform(-5, 5, (12, 3))
ALONG_X = np.outer(np.arange(-3.0, 4.0), [1.0, 0.0, 0.0])


def test_positions_are_aligned_exactly_and_outliers_are_named() -> None:
    known = TRUE.apply(CENTERS)
    known[[2, 7]] += [30.0, 0.0, -20.0]
    found = align_positions(CENTERS, known, max_error=0.5)
    assert isinstance(found, Alignment)
    similarity, agrees = found
    assert np.flatnonzero(~agrees).tolist() == [2, 7]
    assert similarity.scale == pytest.approx(TRUE.scale)
    np.testing.assert_allclose(similarity.rotation, TRUE.rotation, atol=1e-9)
    np.testing.assert_allclose(similarity.translation, TRUE.translation, atol=1e-8)


TILTED = Rotation.from_rotvec([0.7, -0.4, 0.1]).as_matrix()


@pytest.mark.parametrize("num", [3, 4, 12])
@pytest.mark.parametrize("height", [0.0, 2.5, 1e-9])
@pytest.mark.parametrize(
    "plane", [np.eye(3), np.eye(3)[[2, 0, 1]], TILTED], ids=["z", "x", "tilted"]
)
@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_points_in_a_plane_fix_a_similarity(
    num: int, height: float, plane: NDArray[np.float64], noise: float
) -> None:
    flat = (CENTERS[:num] * [1, 1, 0] + [0, 0, height]) @ plane.T
    random = np.random.default_rng(0)
    upright = Similarity(2.5, TRUE.rotation @ plane.T, np.array([3.0, -4.0, 0.0]))
    for similarity in (TRUE, upright):
        known = similarity.apply(flat) + random.normal(0, noise, flat.shape)
        for centers, positions, true in (
            (flat, known, similarity),
            (known, flat, similarity.inverse()),
        ):
            found = align_positions(centers, positions, max_error=0.5)
            assert isinstance(found, Alignment), found
            assert found.agrees.all()
            assert found.similarity.scale == pytest.approx(true.scale, rel=1e-9 + noise)
            np.testing.assert_allclose(found.similarity.rotation, true.rotation, atol=1e-7 + noise)


def test_a_wrong_point_of_a_plane_is_named() -> None:
    flat = CENTERS * [1, 1, 0]
    known = TRUE.apply(flat)
    known[4] += [0.0, 3.0, 0.0]
    found = align_positions(flat, known, max_error=0.5)
    assert isinstance(found, Alignment)
    assert np.flatnonzero(~found.agrees).tolist() == [4]


@pytest.mark.parametrize(
    ("positions", "spread"),
    [
        (ALONG_X, 3.0),
        (np.vstack([ALONG_X, [[1e6, 0, 0], [-2e6, 0, 0]]]), 3.0),
        (np.vstack([np.zeros((9, 3)), [[0, 2.0, 0]]]), 2.0),  # standing, but once
        (np.zeros((3, 3)), 0.0),
    ],
)
def test_strays_do_not_widen_the_spread(positions: NDArray[np.float64], spread: float) -> None:
    assert spread_of(positions) == pytest.approx(spread)


LINE = np.outer(np.arange(6.0), [1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("centers", "why"),
    [
        (CENTERS[:2], "only 2 of them can be compared, and three"),
        (CENTERS[:0], "only 0 of them can be compared, and three"),
        (LINE, "6 of them lie in a line"),
        (np.zeros((5, 3)), "5 of them lie in a line"),
    ],
)
def test_positions_that_do_not_fix_a_similarity_are_refused(
    centers: NDArray[np.float64], why: str
) -> None:
    found = align_positions(centers, TRUE.apply(centers), max_error=0.5)
    assert isinstance(found, str)
    assert why in found


def test_positions_that_contradict_each_other_are_refused() -> None:
    known = RANDOM.uniform(-50, 50, (12, 3))
    found = align_positions(CENTERS, known, max_error=1e-3)
    assert isinstance(found, str)
    assert re.search("only [0-4] of 12 agree with the reconstruction to 0.001", found)


def test_half_of_the_positions_are_too_few() -> None:
    known = TRUE.apply(CENTERS)
    known[:6] += RANDOM.uniform(20, 90, (6, 3))
    found = align_positions(CENTERS, known, max_error=0.5)
    assert isinstance(found, str)
    assert "only 6 of 12 agree" in found


@pytest.mark.parametrize("seed", range(5))
def test_a_line_is_told_by_the_photos_and_not_by_the_noise_of_their_positions(seed: int) -> None:
    random = np.random.default_rng(seed)
    street = np.zeros((30, 3))
    street[:, 0] = np.linspace(0, 100, 30)
    wobbling = street + random.normal(0, [0, 0.5, 0.1], (30, 3))
    for centers in (street, wobbling):
        found = align_positions(centers / 3, centers + random.normal(0, 2, (30, 3)), 10.0)
        assert isinstance(found, str)
        assert "30 of them lie in a line" in found


@pytest.mark.parametrize("seed", range(5))
def test_positions_as_inexact_as_their_extent_are_refused(seed: int) -> None:
    random = np.random.default_rng(seed)
    centers = random.uniform(-1.5, 1.5, (20, 3))
    found = align_positions(centers, centers + random.normal(0, 3, (20, 3)), 10.0)
    assert isinstance(found, str)
    assert "too inexact for their extent" in found
    assert "needed are 5% and 5" in found


@pytest.mark.parametrize("seed", range(5))
def test_positions_around_a_square_fix_the_world_despite_their_noise(seed: int) -> None:
    random = np.random.default_rng(seed)
    centers = random.uniform(-25, 25, (100, 3)) * [1, 1, 0.01]
    found = align_positions(centers / 3, centers + random.normal(0, 2, (100, 3)), 10.0)
    assert isinstance(found, Alignment)
    assert found.similarity.scale == pytest.approx(3, rel=0.05)
    angle = np.degrees(Rotation.from_matrix(found.similarity.rotation).magnitude())
    assert angle < 5


def test_the_same_fix_given_to_many_photos_counts_once() -> None:
    random = np.random.default_rng(0)
    centers = random.uniform(-25, 25, (8, 3))
    known = centers + random.normal(0, 3, (8, 3))
    often = align_positions(np.repeat(centers, 40, axis=0), np.repeat(known, 40, axis=0), 10.0)
    assert isinstance(often, str)
    assert "8 positions" in often


@pytest.mark.parametrize(
    ("known", "why"),
    [
        (CENTERS[:, :2], None),
        (CENTERS[:, :2] * 1.02, None),
        (CENTERS[:, :2] * 1.1, "a scale of 1.1"),
        (LINE[np.arange(12) % 6][:, :2], "positions"),
        (CENTERS[:, :2] * 0, "1 different positions"),
        (CENTERS[:, :2] + np.random.default_rng(1).normal(0, 2, (12, 2)), "a scale of"),
    ],
)
def test_metres_are_believed_only_where_positions_show_them(
    known: NDArray[np.float64], why: str | None
) -> None:
    doubt = scale_doubt(CENTERS[:, :2], known)
    assert (doubt is None) if why is None else (doubt is not None and why in doubt)


def test_a_line_is_enough_for_the_scale() -> None:
    assert scale_doubt(LINE[:, :2], LINE[:, :2] + 7) is None
    assert scale_doubt(LINE[:, :2] * 0, LINE[:, :2]) == "all photos are at one place"


def dataset_with_fixes(
    *systems: str, positions: NDArray[np.float64] | None = None
) -> tuple[Dataset, list[MappingPhoto]]:
    """A photo with a fix for each system; an empty one is not given."""
    camera = Camera("PINHOLE", 64, 48, (50.0, 50.0, 32.0, 24.0))
    sensors = {"camera": Sensor.with_camera("camera", camera)}
    fixes, photos = [], []
    for stamp, system in enumerate(systems):
        name = f"gnss{system[-2:]}"
        sensors[name] = Sensor(name, "", "gnss", (system,) if system else (), None)
        at = (45.0, 6.0 + stamp * 1e-5, 100.0) if positions is None else positions[stamp].tolist()
        fixes.append(GnssRecord(stamp, name, at[1], at[0], at[2], 0.0, 0.0))
        record = FileRecord(stamp, "camera", f"{stamp}.jpg")
        photos.append(MappingPhoto(record, Path(), None, camera, True, None, None, None))
    dataset = Dataset(Path("set"), sensors, {}, {}, (), (), tuple(fixes), ())
    return dataset, photos


@pytest.mark.parametrize("system", ["", "EPSG:4326", "EPSG:4979"])
def test_fixes_in_degrees_become_metres_about_their_middle(system: str) -> None:
    known = known_positions(*dataset_with_fixes(*[system] * 3))
    assert known is not None
    assert known.anchor.geodetic is not None
    assert known.anchor.geodetic.latitude_deg == pytest.approx(45)
    assert known.positions[:, 0] == pytest.approx([-0.788, 0, 0.788], abs=1e-3)
    assert known.positions[:, 1:] == pytest.approx(0, abs=1e-3)


SYDNEY, BERLIN, MARS = (-33.86, 151.2, 20.0), (52.52, 13.405, 34.0), (12.0, -97.0, 9e4)


@pytest.mark.parametrize("wrong", [{}, {0: SYDNEY}, {3: BERLIN}, {1: SYDNEY, 4: BERLIN, 9: MARS}])
@pytest.mark.parametrize(
    ("latitude", "longitude"),
    [
        *((47.0707, 15.4395), (-16.8, 180.0), (65.0, -180.0), (0.0, 179.9999), (71.0, 0.0)),
        *((90.0, 0.0), (-90.0, 77.0), (89.9999, 12.0), (-89.9999, -179.9999)),
    ],
)
def test_axes_point_east_north_and_up_at_the_fixes_that_agree(
    latitude: float, longitude: float, wrong: dict[int, tuple[float, float, float]]
) -> None:
    origin = np.array([latitude, longitude, 400.0])
    enu = CENTERS * 60  # a place of 600 m
    fixes = geodetic_from_enu(enu, origin)
    for row, position in wrong.items():
        fixes[row] = position
    known = known_positions(*dataset_with_fixes(*[""] * len(fixes), positions=fixes))
    assert known is not None
    centers = TRUE.inverse().apply(enu)

    found = align_positions(centers, known.positions, known.max_error)

    assert isinstance(found, Alignment)
    assert np.flatnonzero(~found.agrees).tolist() == sorted(wrong)
    rows = np.flatnonzero(found.agrees)
    moved, from_old = about_rows(known, rows)
    assert moved.anchor.geodetic is not None
    middle = origin_of(moved.anchor.geodetic)
    assert np.linalg.norm(enu_from_geodetic(middle[None], origin)) < 300
    # Up there, seen in the world: a step of 600 m tilts it by 0.005 degrees.
    assert enu_from_ecef(middle)[2] @ enu_from_ecef(origin)[2] > np.cos(np.radians(0.01))
    aligned = (from_old @ found.similarity).apply(centers)[rows]
    np.testing.assert_allclose(aligned, moved.positions[rows], atol=1e-5)
    placed = ecef_from_geodetic(geodetic_from_enu(aligned, middle))
    np.testing.assert_allclose(placed, ecef_from_geodetic(fixes[rows]), atol=1e-5)


def test_the_origin_leaves_fixes_of_photos_that_were_not_placed() -> None:
    # Most photos with a fix are of another town, and are not in the model.
    here, there = (
        geodetic_from_enu(CENTERS[:5], np.array([*at, 0.0])) for at in ((47, 15), (1, 2))
    )
    fixes = np.concatenate([there, there * [1, 2, 1], here])
    known = known_positions(*dataset_with_fixes(*[""] * 15, positions=fixes))
    assert known is not None

    moved, _ = about_rows(known, np.arange(10, 15))

    assert moved.anchor.geodetic is not None
    assert origin_of(moved.anchor.geodetic)[:2] == pytest.approx([47, 15], abs=1e-4)
    expected = enu_from_geodetic(here, origin_of(moved.anchor.geodetic))
    np.testing.assert_allclose(moved.positions[10:], expected, atol=1e-5)


@pytest.mark.parametrize("position", [(95.0, 6.0, 0.0), (45.0, 190.0, 0.0), (45.0, 6.0, 2e5)])
def test_degrees_that_are_no_place_on_earth_are_refused(
    position: tuple[float, float, float],
) -> None:
    fixes = np.array([(45.0, 6.0, 0.0), position, (45.0, 6.1, 0.0)])
    with pytest.raises(InvalidInput) as caught:
        known_positions(*dataset_with_fixes(*[""] * 3, positions=fixes))
    assert caught.value.code == "anchor.position"
    assert caught.value.field is not None
    assert caught.value.field.endswith("records_gnss.txt")


@pytest.mark.parametrize("system", ["EPSG:32601", "EPSG:32760"])
def test_fixes_in_utm_are_metres(system: str) -> None:
    known = known_positions(*dataset_with_fixes(*[system] * 3))
    assert known is not None
    assert known.anchor.geodetic is None
    assert known.positions[0].tolist() == [6.0, 45.0, 100.0]


@pytest.mark.parametrize(
    ("systems", "got"),
    [
        (["EPSG:4258"], "EPSG:4258"),
        (["EPSG:2154"], "EPSG:2154"),
        (["EPSG:32661"], "EPSG:32661"),
        (["EPSG:32600"], "EPSG:32600"),
        (["lambert"], "lambert"),
        (["EPSG:32632", "EPSG:32633"], "EPSG:32632, EPSG:32633"),
        (["", "EPSG:4979"], "EPSG:4326, EPSG:4979"),
    ],
)
def test_other_coordinate_systems_and_mixtures_are_refused(systems: list[str], got: str) -> None:
    with pytest.raises(DatasetError) as caught:
        known_positions(*dataset_with_fixes(*systems))
    assert caught.value.code == "gnss.epsg"
    assert caught.value.got == got
    assert caught.value.field is not None
    assert caught.value.field.endswith("sensors.txt")


def test_without_fixes_nothing_is_known() -> None:
    assert known_positions(*dataset_with_fixes()) is None


def poses_at(centers: NDArray[np.float64]) -> list[Pose]:
    rotations = Rotation.random(len(centers), rng=1).as_matrix()
    return [Pose(r, -r @ c) for r, c in zip(rotations, centers, strict=True)]


@pytest.mark.parametrize("centers", [CENTERS, LINE])
def test_poses_are_brought_back_also_when_their_positions_lie_in_a_line(
    centers: NDArray[np.float64],
) -> None:
    moved = poses_at(centers)
    given = [TRUE.move(pose) for pose in moved]
    back = align_poses(moved, given)
    assert back.scale == pytest.approx(TRUE.scale)
    for pose, truth in zip(moved, given, strict=True):
        assert max(pose_error(back.move(pose), truth)) < 1e-9


def test_a_moved_pose_sees_moved_points_where_it_saw_them() -> None:
    pose = poses_at(CENTERS)[3]
    seen, seen_after = pose.apply(CENTERS), TRUE.move(pose).apply(TRUE.apply(CENTERS))
    np.testing.assert_allclose(seen_after, TRUE.scale * seen, atol=1e-12)


def test_a_rigid_fit_keeps_the_scale_and_has_the_middle_and_directions_of_the_positions() -> None:
    known = TRUE.apply(CENTERS)
    rigid = at_own_scale(TRUE, CENTERS, known)
    assert rigid.scale == 1.0
    np.testing.assert_array_equal(rigid.rotation, TRUE.rotation)
    np.testing.assert_allclose(rigid.apply(CENTERS).mean(axis=0), known.mean(axis=0), atol=1e-9)
