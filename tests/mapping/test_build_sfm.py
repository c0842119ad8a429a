from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from mapping.pairing import PAIRINGS, PairSettings
from mapping.sample import ANCHOR_ALTITUDE_M, ANCHOR_LATITUDE_DEG, ANCHOR_LONGITUDE_DEG
from mapping.sfm import SfmSettings
from visloc.archive import Map, MapStore
from visloc.errors import DatasetError, InvalidInput, VislocError
from visloc.evaluation import pose_error
from visloc.geodesy import enu_from_geodetic, geodetic_from_enu
from visloc.geometry import Pose
from visloc.kapture import GnssRecord, Sensor, read_dataset

Build = Callable[..., Map]
Errors = Callable[[Map, Path], NDArray[np.float64]]
Rewrite = Callable[..., None]


def sfm(**settings: object) -> SfmSettings:
    return SfmSettings(**settings)  # type: ignore[arg-type]


def poses_of(opened: Map) -> dict[str, NDArray[np.float64]]:
    return {
        image.name: pose for image, pose in zip(opened.images, opened.image_poses, strict=True)
    }


def test_queries_are_localized_to_millimetres_in_a_map_by_matches(
    walk: Path, sfm_walk: Map, localization_errors: Errors
) -> None:
    errors = localization_errors(sfm_walk, walk / "query")
    assert np.median(errors, axis=0) == pytest.approx([0.0, 0.0], abs=0.1)
    assert errors[:, 0].max() < 0.01
    assert errors[:, 1].max() < 0.2


def test_given_poses_are_in_the_map_bit_by_bit(walk: Path, sfm_walk: Map) -> None:
    dataset, found = read_dataset(walk / "mapping"), poses_of(sfm_walk)
    assert sfm_walk.manifest.world.metric
    assert sfm_walk.manifest.world.anchor is not None
    assert sfm_walk.manifest.world.anchor.kind == "dataset"
    for record in dataset.images:
        pose = dataset.pose(record)
        assert pose is not None
        assert np.array_equal(found[record.path], [*pose.rotation_wxyz, *pose.translation])
    assert dict(sfm_walk.cameras) == {
        name: sensor.camera for name, sensor in dataset.sensors.items() if sensor.kind == "camera"
    }


def test_landmarks_tell_how_well_they_were_seen(sfm_walk: Map) -> None:
    assert sfm_walk.track_lengths.min() >= 2
    assert sfm_walk.errors_px.max() <= 4.0
    assert sfm_walk.angles_deg.min() >= 1.5
    assert sfm_walk.manifest.method.name == "sfm"
    assert sfm_walk.manifest.method.settings["pairs"] == ["retrieval"]


@pytest.mark.parametrize("names", [*((name,) for name in PAIRINGS), ("sequence", "distance")])
def test_every_pairing_makes_a_map_that_localizes(
    walk: Path,
    tmp_path: Path,
    rgbd_walk: Map,
    build_walk: Build,
    localization_errors: Errors,
    names: tuple[str, ...],
) -> None:
    pairing = PairSettings(top_k=5, max_distance=3, near=0.3, far=8)
    settings = sfm(pairs=names, pairing=pairing, covisible_in=rgbd_walk)
    built = build_walk(walk / "mapping", tmp_path, sfm=settings)
    assert built.manifest.method.settings["pairs"] == list(names)
    assert localization_errors(built, walk / "query")[:, 0].max() < 0.03
    num_pairs = len((built.path / "pairs.txt").read_text().splitlines()) - 1
    assert (num_pairs == 16 * 15 / 2) == (names == ("exhaustive",))
    text = (built.path / "pairs.txt").read_text()
    assert ("left" in text) and ("right" in text)


def test_the_pairs_in_a_map_make_the_same_map_again(
    walk: Path, tmp_path: Path, build_walk: Build
) -> None:
    settings = sfm(pairs=("sequence", "retrieval"), pairing=PairSettings(top_k=4))
    paired = build_walk(walk / "mapping", tmp_path, sfm=settings)
    pairs = paired.path / "pairs.txt"
    again = build_walk(walk / "mapping", tmp_path, sfm=sfm(pairs_file=pairs))
    third = build_walk(walk / "mapping", tmp_path, sfm=sfm(pairs_file=again.path / "pairs.txt"))
    assert again.manifest.content_hash == third.manifest.content_hash
    files = again.manifest.files
    # The settings say where the pairs came from; all else is the same, pairs.txt included.
    assert files == paired.manifest.files
    assert "pairs.txt" in files


@pytest.mark.parametrize("refine", [("points",), ("poses",), ("intrinsics",)])
def test_what_is_refined_changes_and_nothing_else_and_the_frame_stays(
    walk: Path,
    tmp_path: Path,
    sfm_walk: Map,
    build_walk: Build,
    localization_errors: Errors,
    refine: tuple[str, ...],
) -> None:
    built = build_walk(walk / "mapping", tmp_path, sfm=sfm(refine=refine))
    assert built.manifest.method.settings["refine"] == list(refine)
    before, after = poses_of(sfm_walk), poses_of(built)
    same = [np.array_equal(before[name], after[name]) for name in before]
    assert all(same) == (refine != ("poses",))
    assert (dict(built.cameras) == dict(sfm_walk.cameras)) == (refine != ("intrinsics",))
    moved = [
        pose_error(Pose.from_quaternion(a[:4], a[4:]), Pose.from_quaternion(b[:4], b[4:]))
        for a, b in zip(before.values(), after.values(), strict=True)
    ]
    assert np.max(moved, axis=0) == pytest.approx([0.0, 0.0], abs=0.3)
    assert localization_errors(built, walk / "query")[:, 0].max() < 0.02
