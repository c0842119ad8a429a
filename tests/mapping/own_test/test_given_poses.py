"""Poses and depth maps that matches contradict are in doubt, and the usual mistakes are named."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mapping.own_test import given_poses
from mapping.own_test.given_poses import _distances, _factor, _is_along_ray, _Pair, _Written
from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from mapping.stages.photos import MappingPhoto
from samples.trajectories import mapping_trajectory
from visloc.archive import MapStore
from visloc.archive.schema import Doubt
from visloc.errors import NotFound
from visloc.geometry import Camera, Pose
from visloc.kapture import FileRecord, read_dataset, write_dataset

CAMERA = Camera("SIMPLE_PINHOLE", 640, 480, (500.0, 320.0, 240.0))
OPENGL, UP = np.diag([1.0, -1.0, -1.0]), np.diag([1.0, -1.0, 1.0])
WITH_OPENGL = "poses with OpenGL axes"
BODY = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
TRUE = mapping_trajectory(30)


def xyzw(pose: Pose) -> Pose:
    return Pose.from_quaternion(np.roll(pose.rotation_wxyz, -1), pose.translation)


def opengl(pose: Pose) -> Pose:
    return Pose(OPENGL @ pose.rotation, OPENGL @ pose.translation)


def noisy(centimetres: float) -> Callable[[Pose], Pose]:
    random = np.random.default_rng(0)

    def write(pose: Pose) -> Pose:
        center = pose.center + random.normal(0, centimetres / 100, 3)
        return Pose(pose.rotation, -pose.rotation @ center)

    return write


def photo(row: int, pose: Pose) -> MappingPhoto:
    record = FileRecord(row, "camera", f"{row:02}.jpg")
    return MappingPhoto(record, Path(record.path), None, CAMERA, True, pose, None, None)


def pairs_of(poses: list[Pose]) -> list[_Pair]:
    """What exact matches of photos one to four steps apart tell."""
    pairs, random = [], np.random.default_rng(0)
    for first in range(len(poses)):
        for second in range(first + 1, min(first + 5, len(poses))):
            b_from_a = poses[second] @ poses[first].inverse()
            unit = b_from_a.translation / np.linalg.norm(b_from_a.translation)
            none = np.empty((0, 2), np.float32), np.empty(0)
            points = random.uniform((-1, -1, 2), (1, 1, 6), (60, 3))
            there = b_from_a.apply(points)
            rays = points / points[:, 2:], there / there[:, 2:]
            pairs.append(
                _Pair(first, second, Pose(b_from_a.rotation, unit), 10.0, *none, rays, 0.01)
            )
    return pairs


def look_alikes(pairs: list[_Pair]) -> list[_Pair]:
    """Pairs whose matches fit rotations that have nothing to do with one another."""
    random = Rotation.random(len(pairs), np.random.default_rng(0)).as_matrix()
    return [
        replace(pair, b_from_a=Pose(rotation, pair.b_from_a.translation))
        for pair, rotation in zip(pairs, random, strict=True)
    ]


def doubt_about(written: list[Pose], pairs: list[_Pair] | None = None) -> Doubt | None:
    photos = [photo(row, pose) for row, pose in enumerate(written)]
    of_devices = [
        _Written("camera", row, Pose.identity(), pose) for row, pose in enumerate(written)
    ]
    return given_poses._doubt_about_poses(photos, of_devices, pairs or pairs_of(TRUE))


@pytest.mark.parametrize(
    ("write", "named"),
    [
        (lambda p: p.inverse(), "like camera-to-world poses."),
        (opengl, f"world-to-camera {WITH_OPENGL}"),
        (lambda p: opengl(p).inverse(), f"camera-to-world {WITH_OPENGL}"),
        (lambda p: Pose(p.rotation, p.center), "centre in place of the translation"),
        (xyzw, "order x, y, z, w"),
        (lambda p: Pose(BODY @ p.rotation, BODY @ p.translation), "body axes"),
        (lambda p: Pose(p.rotation.T, p.translation), "transposed rotations"),
        (lambda p: Pose(UP @ p.rotation @ UP, UP @ p.translation), "left-handed frame (y mirrored"),
    ],
)  # fmt: skip
def test_poses_of_another_convention_are_in_doubt_and_it_is_named(
    write: Callable[[Pose], Pose], named: str
) -> None:
    doubt = doubt_about([write(pose) for pose in TRUE])

    assert doubt is not None
    assert doubt.kind == "poses"
    assert named in doubt.message


@pytest.mark.parametrize(("steps", "named"), [(1, "the next photo"), (-1, "the photo before")])
def test_poses_of_neighbouring_photos_are_in_doubt_and_named(steps: int, named: str) -> None:
    doubt = doubt_about(TRUE[steps:] + TRUE[:steps])

    assert doubt is not None
    assert named in doubt.message


@pytest.mark.parametrize("centimetres", [0, 5, 10, 20])
def test_right_poses_with_noise_are_not_in_doubt(centimetres: float) -> None:
    assert doubt_about([noisy(centimetres)(pose) for pose in TRUE]) is None


def test_poses_of_other_photos_are_in_doubt_without_a_name() -> None:
    order = np.random.default_rng(0).permutation(len(TRUE))

    doubt = doubt_about([TRUE[row] for row in order])

    assert doubt is not None
    assert "No usual convention" in doubt.message


def test_photos_that_only_look_alike_say_nothing_of_poses() -> None:
    order = np.random.default_rng(0).permutation(len(TRUE))
    apart = [TRUE[row] for row in order]  # no match fits these

    assert doubt_about(apart, look_alikes(pairs_of(TRUE))) is None


def test_photos_of_which_a_third_look_alike_contradict_wrong_poses() -> None:
    pairs = pairs_of(TRUE)
    third = {id(pair) for pair in pairs[::3]}
    mixed = [pair for pair in pairs if id(pair) not in third] + look_alikes(pairs[::3])
    order = np.random.default_rng(0).permutation(len(TRUE))

    assert doubt_about([TRUE[row] for row in order], mixed) is not None


def test_distances_are_those_of_exact_rays() -> None:
    b_from_a = Pose(np.eye(3), np.array([1.0, 0.0, 0.0]))
    points = np.random.default_rng(0).uniform((-1, -1, 2), (1, 1, 9), (50, 3))
    there = b_from_a.apply(points)

    found = _distances(points / points[:, 2:], there / there[:, 2:], b_from_a.translation)

    np.testing.assert_allclose(found, points[:, 2], rtol=1e-9)


def test_factor_survives_noise_of_the_given_positions() -> None:
    random = np.random.default_rng(0)
    ways = random.uniform(0.1, 2.0, 200)

    factor, error = _factor(1.2 * ways, ways + random.normal(0, 0.2, 200))

    assert abs(factor / 1.2 - 1) < 3 * error
    assert error < 0.03


def test_distance_along_the_ray_is_told_from_a_wrong_unit() -> None:
    slants = np.log(np.sqrt(1 + np.random.default_rng(0).uniform(0, 0.5, 500)))
    factor = float(np.exp(np.median(slants)))

    assert _is_along_ray(slants - np.median(slants), slants, factor)
    assert not _is_along_ray(np.zeros(500), slants, factor)


def copied(source: Path, folder: Path, write: Callable[[Pose], Pose]) -> Path:
    dataset = read_dataset(source)
    poses = {key: write(pose) for key, pose in dataset.trajectories.items()}
    folder.mkdir()
    write_dataset(replace(dataset, root=folder, trajectories=poses))
    (folder / "sensors" / "records_data").symlink_to(source / "sensors" / "records_data")
    return folder


@pytest.mark.parametrize(
    ("method", "write", "expected"),
    [
        ("sfm", Pose.inverse, "camera-to-world poses"),
        ("rgbd", xyzw, "order x, y, z, w"),
        ("retrieval-only", Pose.inverse, "camera-to-world poses"),
    ],
)
def test_map_of_wrong_poses_is_published_but_not_put_into_use(
    sample: Path,
    tmp_path: Path,
    method: str,
    write: Callable[[Pose], Pose],
    expected: str,
) -> None:
    dataset = copied(sample / "mapping", tmp_path / "data", write)
    build_map(
        BuildSettings(dataset, "room", tmp_path / "maps", method=method, local_features="sift"),
        lambda *_: None,
    )

    store = MapStore(tmp_path / "maps")
    with pytest.raises(NotFound):
        store.current_version("room")
    opened = store.open(f"room@{store.versions('room')[-1]}")
    found = {doubt.kind: doubt.message for doubt in opened.manifest.parts.doubts}
    assert expected in found["poses"]
