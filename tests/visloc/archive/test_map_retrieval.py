"""What a map says about how its photos are ranked."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import tests.fuzz.tiny_map as tiny
from visloc.archive import MapContent, open_map, verify_map, write_map
from visloc.errors import MapCorrupt
from visloc.options import Fusion
from visloc.retrieval.fusion import EQUAL_GHARM, LateFusion


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[LateFusion], Path]:
    """Write a tiny map with this default."""

    def write_with(fusion: LateFusion) -> Path:
        def with_fusion(folder: Path, content: MapContent, **named: str) -> str:
            return write_map(folder, replace(content, fusion=fusion), **named)

        monkeypatch.setattr(tiny, "write_map", with_fusion)
        tiny.write_tiny_map(tmp_path / "map")
        return tmp_path / "map"

    return write_with


def edit(folder: Path, change: Callable[[dict[str, Any]], None]) -> None:
    path = folder / "manifest.json"
    manifest = json.loads(path.read_text())
    change(manifest)
    path.write_text(json.dumps(manifest))


@pytest.mark.parametrize(
    "fusion", [EQUAL_GHARM, LateFusion(Fusion.ROUND_ROBIN, {"densevlad": 2.5})]
)
def test_the_default_comes_back_as_it_was_written(
    write: Callable[[LateFusion], Path], fusion: LateFusion
) -> None:
    opened = verify_map(write(fusion))
    assert opened.fusion == fusion
    assert opened.manifest.format_version == "3.2"


def test_maps_that_do_not_say_are_asked_by_gharm_of_all(
    write: Callable[[LateFusion], Path],
) -> None:
    folder = write(EQUAL_GHARM)
    edit(folder, lambda manifest: manifest.pop("retrieval"))
    assert open_map(folder).fusion == EQUAL_GHARM


@pytest.mark.parametrize(
    ("record", "said"),
    [
        ({"fusion": "borda"}, "retrieval.fusion: Input should be 'gharm'"),
        ({"weights": {"gem": 1.0}}, "weights of others than the map's densevlad"),
        ({"weights": {"densevlad": 0.0}}, "the weight is out of range"),
        ({"weights": {"densevlad": 1e300}}, "the weight is out of range"),
        ({"weights": {}}, "there are no weights"),
        ({"weights": ["densevlad"]}, "should be an object"),
        ("gharm", "retrieval"),
    ],
)
def test_a_default_that_means_nothing_is_refused(
    write: Callable[[LateFusion], Path], record: object, said: str
) -> None:
    folder = write(EQUAL_GHARM)
    edit(folder, lambda manifest: manifest.update(retrieval=record))
    with pytest.raises(MapCorrupt) as caught:
        open_map(folder)
    assert caught.value.code == "map.manifest"
    assert said in str(caught.value)
    assert len(str(caught.value)) < 1000
