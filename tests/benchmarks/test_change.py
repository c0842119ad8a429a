"""Kinds of change get stronger with their levels, and each photo is lost at one stage."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.change.kinds import KINDS
from benchmarks.change.stages import Staged, Staging
from benchmarks.change.table import write_tables
from benchmarks.trust.outcomes import Query, RigPhoto
from visloc.archive import MapStore
from visloc.evaluation import Threshold
from visloc.features import make_local_features
from visloc.geometry import Pose
from visloc.localization.localizer import Localizer
from visloc.photos.reading import Photo


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_strengths_rise(kind: str) -> None:
    assert list(KINDS[kind].strengths) == sorted(set(KINDS[kind].strengths))


def staged(lost: str, ranks: dict[str, int], reason: str | None = None) -> Staged:
    return Staged(
        "night", "m", "p", lost, reason, ranks, 3, 100, 40, 40, 0, 0.1, 1.0, 2.0, 0.5, 0.1
    )  # fmt: skip


def test_the_tables_count_each_photo_once() -> None:
    found = [
        staged("right", {"a": 1, "fused": 1}),
        staged("gate", {"a": 21, "fused": 2}, "low_inlier_ratio"),
        staged("retrieval", {"a": 0, "fused": 30}, "too_few_inliers"),
    ]
    lines = list(write_tables(found))
    told = "low_inlier_ratio 1, too_few_inliers 1"
    assert f"| night | 3 | 1 | 0 | 1 | 0 | 0 | 1 | {told} | 0.100 | 100% |" in lines
    assert "| night | 3 | 1 | 2 |" in lines  # among the first 20, by descriptor a and fused


def test_a_stage_is_blamed_with_the_truth(built_maps: Path) -> None:
    """A photo of noise in the right place has retrieval or matching to blame, never the gate."""
    localizer = Localizer(MapStore(built_maps).open("room"), make_local_features("sift"))
    opened = localizer.map
    camera = opened.cameras[opened.images[3].camera]
    pose = localizer.geometry.viewpoints.pose(3)
    truth = replace(pose, translation=pose.translation - pose.rotation @ localizer.geometry.origin)
    random = np.random.default_rng(0)
    noise = Photo(random.integers(0, 256, (camera.height, camera.width, 3), dtype=np.uint8))
    photos = (RigPhoto("camera", Pose.identity(), noise, camera),)
    query = Query("room", "room", "noise.jpg", photos, truth, Threshold(0.5, 5.0))
    found = Staging(localizer).ask(query, "noise")
    assert found.lost in ("retrieval", "matching")
    assert found.error is None
    assert found.supported < 30
    assert 1 <= found.ranks["fused"] <= len(opened.images)
