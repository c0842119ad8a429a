"""What teaches how sure a doubtful pose must be."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.probability.expectations import Tried, in_the_dark, table_of_scores, tried
from benchmarks.probability.teachers import Question, is_right
from tests.conftest import Query
from visloc.archive import MapStore
from visloc.features import make_local_features
from visloc.geometry import Camera, Pose
from visloc.images import read_photo_file
from visloc.localization.localizer import Localizer


@pytest.fixture(scope="module")
def localizer(built_maps: Path) -> Localizer:
    return Localizer(MapStore(built_maps).open("room"), make_local_features("sift"))


def test_only_a_photo_without_an_answer_is_tried(
    localizer: Localizer, queries: list[Query]
) -> None:
    query = queries[0]
    rgb = read_photo_file(query.path).rgb
    question = Question(localizer, "plain", rgb, query.camera, None)
    assert tried(question) is None
    noise = np.random.default_rng(0).integers(0, 256, rgb.shape, dtype=np.uint8)
    mixed = (0.12 * rgb + 0.88 * noise).astype(np.uint8)
    found = tried(replace(question, rgb=mixed))
    assert found is not None
    assert found.right is None  # without a truth no pose is right


def test_a_pose_between_right_and_wrong_teaches_nothing(localizer: Localizer) -> None:
    truth, reach = localizer.geometry.viewpoints.pose(0), localizer.geometry.reach
    question = Question(localizer, "plain", np.zeros((8, 8, 3), np.uint8), _camera(), truth)

    def moved(share: float) -> Pose:
        return replace(truth, translation=truth.translation + np.array([share * reach, 0.0, 0.0]))

    assert [is_right(question, moved(share)) for share in (0.05, 0.15, 0.5)] == [True, None, False]


def test_a_photo_in_the_dark_keeps_its_view() -> None:
    """Pixels and camera shrink alike."""
    image = np.full((481, 1001, 3), 200, np.uint8)
    camera = replace(_camera(), width=1001, height=481, params=(800.0, 800.0, 500.5, 240.5))
    dark, reduced = in_the_dark(image, camera, image, np.random.default_rng(0))
    assert dark.shape == (reduced.height, reduced.width, 3)
    assert reduced.width == 640
    assert reduced.params[0] == pytest.approx(800.0 * 640 / 1001)


def test_scores_are_counted_by_map(tmp_path: Path) -> None:
    found = [
        Tried("dark", 9.0, 3.0, None, 0.9),
        Tried("print", None, 5.5, "unlikely_pose", 0.05),
        Tried("plain", None, None, None, None),
    ]
    lines = "".join(json.dumps(asdict(each)) + "\n" for each in found)
    (tmp_path / "kitchen.jsonl").write_text(lines, encoding="utf-8")
    assert "| kitchen | 3 | 1 | 2 | 5.5 | 1, 1, 1 | 1, 0, 0 |" in list(table_of_scores(tmp_path))


def _camera() -> Camera:
    return Camera("PINHOLE", 8, 8, (8.0, 8.0, 4.0, 4.0))
