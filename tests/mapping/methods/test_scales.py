"""The sample as the model of a room, as a room, and as a town: everything is proportional."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from conftest import Query
from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from visloc.archive import Map
from visloc.geometry import Pose
from visloc.in_process import LocalMap, open_map
from visloc.kapture import read_dataset, write_dataset


def scaled(source: Path, root: Path, scale: float) -> Path:
    """The dataset with all lengths times ``scale``."""

    def of(pose: Pose) -> Pose:
        return Pose(pose.rotation, scale * pose.translation)

    dataset = read_dataset(source)
    shutil.copytree(source / "sensors" / "records_data", root / "sensors" / "records_data")
    for path in root.rglob("*.depth"):
        (np.float32(scale) * np.fromfile(path, "<f4")).tofile(path)
    rigs = {
        rig: {sensor: pose and of(pose) for sensor, pose in members.items()}
        for rig, members in dataset.rigs.items()
    }
    trajectories = {key: of(pose) for key, pose in dataset.trajectories.items()}
    write_dataset(replace(dataset, root=root, rigs=rigs, trajectories=trajectories))
    return root


@pytest.fixture(scope="module")
def map_at(
    sample: Path, tmp_path_factory: pytest.TempPathFactory
) -> Callable[[float, str], LocalMap]:
    @cache
    def build(scale: float, method: str) -> LocalMap:
        folder = tmp_path_factory.mktemp("scaled")
        dataset = scaled(sample / "mapping", folder / "mapping", scale)
        settings = BuildSettings(dataset, "room", folder, local_features="sift", method=method)
        build_map(settings, lambda *_: None)
        return open_map("room", folder)

    return build


def errors(asked: LocalMap, queries: Sequence[Query], scale: float) -> list[float]:
    found = []
    for query in queries:
        row = asked.localize(query.path, query.camera).row()
        assert row["status"] == "localized", row
        center = np.array([row[axis] for axis in "xyz"])
        found.append(float(np.linalg.norm(center / scale - query.cam_from_world.center)))
    return found


def own_test(opened: Map) -> tuple[int, int, int]:
    test = opened.manifest.parts.own_test
    assert test is not None
    return test.tested, test.localized, test.wrong


@pytest.mark.parametrize(
    ("scale", "method", "voxel_size", "landmarks_off"),
    [
        # Cells are rounded, so that they are not always as large a part of the scene.
        (1 / 60, "rgbd", 2e-4, 0.25),
        (20.0, "rgbd", 0.2, 0.01),
        (800.0, "rgbd", 5.0, 0.25),
        (1 / 60, "sfm", None, 0.01),
        (20.0, "sfm", None, 0.01),
        (800.0, "sfm", None, 0.01),
    ],
)
def test_a_scaled_scene_gives_the_same_map_and_answers_in_its_unit(
    map_at: Callable[[float, str], LocalMap],
    queries: list[Query],
    scale: float,
    method: str,
    voxel_size: float | None,
    landmarks_off: float,
) -> None:
    room, other = map_at(1.0, method), map_at(scale, method)
    was, now = room.archive.manifest, other.archive.manifest
    assert now.method.settings.get("voxel_size") == voxel_size
    assert now.counts.observations == pytest.approx(was.counts.observations, rel=0.01)
    assert now.counts.landmarks == pytest.approx(was.counts.landmarks, rel=landmarks_off)
    assert own_test(other.archive) == own_test(room.archive)
    assert now.notes == was.notes
    largest = max(errors(room, queries, 1.0))
    assert max(errors(other, queries, scale)) < 2 * largest < 0.1
