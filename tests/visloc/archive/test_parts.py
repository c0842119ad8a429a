from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.fuzz.tiny_map import write_tiny_map
from visloc.archive import OwnTest, add_own_test, open_map, verify_map, write_tested
from visloc.archive.schema import MAX_WRONG_SCORES
from visloc.errors import MapCorrupt
from visloc.localization.map_view.constraints import MapGeometry
from visloc.pose.motion import PHOTO_ONLY
from visloc.types import Uncertainty

GOOD: dict[str, Any] = {
    "tested": 12,
    "localized": 11,
    "wrong": 1,
    "position_factor": 3.5,
    "orientation_factor": 6.0,
    "independent": True,
    "wrong_at": [{"inliers": 80, "inlier_ratio": 0.2}],
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_tiny_map(tmp_path / "map")
    return tmp_path / "map"


def edit(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    path = folder / "manifest.json"
    manifest = json.loads(path.read_text())
    change(manifest)
    path.write_text(json.dumps(manifest))


def test_an_own_test_is_kept_and_every_byte_stays_verified(folder: Path) -> None:
    version = add_own_test(folder, OwnTest(**GOOD), version="v2-")
    opened = verify_map(folder)
    assert opened.manifest.parts.own_test == OwnTest(**GOOD)
    assert opened.manifest.format_version == "3.2"
    assert version == opened.manifest.version == f"v2-{opened.manifest.content_hash[:8]}"


def test_a_tested_map_widens_poses_by_what_it_learned(folder: Path) -> None:
    add_own_test(folder, OwnTest(**GOOD), version="v2")
    errors = MapGeometry(open_map(folder)).errors
    assert (errors.position_factor, errors.orientation_factor) == (3.5, 6.0)
    assert errors.uncertainty is Uncertainty.WHOLE


@pytest.mark.parametrize(("kind", "bent"), [("positions", 0.3), ("gnss", 0.0), ("dataset", 0.0)])
def test_only_a_map_laid_over_given_positions_knows_how_bent_it_is(
    folder: Path, kind: str, bent: float
) -> None:
    """Fixes of GNSS scatter by themselves."""
    add_own_test(folder, OwnTest(**GOOD), version="v2")
    anchor = {"kind": kind, "images": 5, "rms": 0.3 * 3**0.5}
    edit(folder, lambda manifest: manifest["world"].update(anchor=anchor))
    assert MapGeometry(open_map(folder)).errors.position_std == pytest.approx(bent)


@pytest.mark.parametrize("version", ["1.0", "1.3", "2.2"])
def test_older_maps_open_and_say_photo_only(folder: Path, version: str) -> None:
    def older(manifest: dict[str, Any]) -> None:
        manifest["format_version"] = version
        del manifest["parts"]

    edit(folder, older)
    opened = open_map(folder)
    assert opened.manifest.parts.own_test is None
    assert MapGeometry(opened).errors == PHOTO_ONLY


def test_an_older_map_gets_its_test_over_the_same_files(folder: Path, tmp_path: Path) -> None:
    edit(folder, lambda manifest: manifest.update(format_version="2.2"))
    opened, target = open_map(folder), tmp_path / "tested"
    target.mkdir()
    write_tested(opened, target, OwnTest(**GOOD), version="v2", created="2026-01-02T03:04:05+00:00")
    tested = verify_map(target)
    assert tested.manifest.parts.own_test == OwnTest(**GOOD)
    assert tested.manifest.files == opened.manifest.files
    assert open_map(folder).manifest.parts.own_test is None


def test_parts_of_a_newer_format_are_ignored(folder: Path) -> None:
    edit(folder, lambda manifest: manifest.update(parts={"own_test": GOOD, "news": [1]}))
    assert open_map(folder).manifest.parts.own_test == OwnTest(**GOOD)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *(("position_factor", value) for value in (0.0, 0.99, -3.0, 1001.0, 1e300, "wide", None)),
        *(("orientation_factor", value) for value in (float("nan"), float("inf"), 0)),
        *(("tested", value) for value in (-1, 5, 1.5, 10**400)),
        *(("localized", value) for value in (-1, 13, 0)),
        *(("wrong", value) for value in (-1, 12, 0)),
        ("independent", "perhaps"),
        ("wrong_at", [{"inliers": -1, "inlier_ratio": 0.2}]),
        ("wrong_at", [{"inliers": 1, "inlier_ratio": 1.2}]),
        ("wrong_at", [{"inliers": 1, "inlier_ratio": float("nan")}]),
        ("wrong_at", [{"inliers": 1, "inlier_ratio": 0.1}] * (MAX_WRONG_SCORES + 1)),
        ("wrong_at", 3),
    ],
)
def test_an_own_test_that_cannot_be_is_refused(folder: Path, field: str, value: object) -> None:
    edit(folder, lambda manifest: manifest.update(parts={"own_test": {**GOOD, field: value}}))
    with pytest.raises(MapCorrupt) as caught:
        open_map(folder)
    assert caught.value.code == "map.manifest"


@pytest.mark.parametrize("parts", [[], "own_test", 3, None, {"own_test": []}, {"own_test": {}}])
def test_parts_that_are_none_are_refused(folder: Path, parts: object) -> None:
    edit(folder, lambda manifest: manifest.update(parts=parts))
    with pytest.raises(MapCorrupt) as caught:
        open_map(folder)
    assert caught.value.code == "map.manifest"
