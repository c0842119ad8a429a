from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapping.methods.sfm_settings import SfmSettings
from mapping.pairing import PairSettings
from mapping.sample import ANCHOR_ALTITUDE_M, ANCHOR_LATITUDE_DEG, ANCHOR_LONGITUDE_DEG
from visloc.archive import Map
from visloc.errors import InvalidInput
from visloc.geodesy import geodetic_from_enu
from visloc.kapture import GnssRecord, read_dataset

Build = Callable[..., Map]
ESTIMATE = SfmSettings(pairing=PairSettings(top_k=4), poses="estimate")
ANCHOR = np.array([ANCHOR_LATITUDE_DEG, ANCHOR_LONGITUDE_DEG, ANCHOR_ALTITUDE_M])


@pytest.fixture
def with_fixes(walk_copy: Path, rewrite: Callable[..., None]) -> Path:
    """The walk without poses, with a fix for every photo."""
    dataset = read_dataset(walk_copy)
    fixes, images = [], []
    for stamp, record in enumerate(dataset.images):
        pose = dataset.pose(record)
        assert pose is not None
        latitude, longitude, altitude = geodetic_from_enu(pose.center[None], ANCHOR)[0]
        fixes.append(GnssRecord(stamp, "gnss", longitude, latitude, altitude, 0.0, 0.0))
        images.append(replace(record, timestamp=stamp))
    rewrite(
        walk_copy,
        rigs={},
        trajectories={},
        depth_maps=(),
        images=tuple(images),
        gnss=tuple(fixes),
    )
    return walk_copy


@pytest.mark.slow
def test_a_map_anchored_on_earth_knows_what_is_down(
    with_fixes: Path, tmp_path: Path, build_walk: Build
) -> None:
    built = build_walk(with_fixes, tmp_path / "maps", sfm=ESTIMATE)
    assert built.manifest.world.anchor is not None
    assert built.manifest.world.anchor.geodetic is not None
    assert built.manifest.world.gravity == (0.0, 0.0, -1.0)


def test_a_gravity_that_contradicts_a_geodetic_world_is_refused_before_the_work(
    with_fixes: Path, tmp_path: Path, build_walk: Build
) -> None:
    with pytest.raises(InvalidInput, match=r"--gravity.*got 0,1,0, 90.0 degrees off") as caught:
        build_walk(with_fixes, tmp_path / "maps", sfm=ESTIMATE, gravity=(0.0, 1.0, 0.0))
    assert caught.value.code == "build.gravity"
    assert not any(path.is_file() for path in (tmp_path / "maps" / ".work" / "walk").rglob("*"))


@pytest.mark.slow
def test_in_an_arbitrary_frame_gravity_is_left_out_with_a_note(
    walk_copy: Path, tmp_path: Path, build_walk: Build, rewrite: Callable[..., None]
) -> None:
    rewrite(walk_copy, rigs={}, trajectories={}, gnss=(), depth_maps=())
    built = build_walk(walk_copy, tmp_path / "maps", sfm=ESTIMATE, gravity=(0.0, 0.0, -1.0))
    assert built.gravity is None
    assert any("--gravity says nothing of it" in note for note in built.manifest.notes)


def test_given_poses_say_nothing_of_gravity(sfm_walk: Map) -> None:
    assert sfm_walk.gravity is None
