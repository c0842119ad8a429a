from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapping.cli.display import print_map
from visloc.archive import Anchor, Map, MapStore


def shown(opened: Map, capsys: pytest.CaptureFixture[str]) -> str:
    """Return what a summary says of a map, on one line."""
    print_map(opened)
    return " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("kind", "metric", "settings", "said"),
    [
        (
            *("none", True, {"scale": {"by": "length", "metres": 2.85}}),
            "metric, size from --scale; origin and directions are arbitrary",
        ),
        (
            *("none", True, {"scale": {"by": "markers", "metres": 0.16}}),
            "metric, size from --marker-size; origin and directions are arbitrary",
        ),
        ("none", True, {}, "metric; origin and directions are arbitrary"),
        (
            *("none", False, {"scale": {}}),
            "not metric; origin, directions and size are arbitrary",
        ),
        (
            *("positions", True, {"scale": {"by": "length"}}),
            "metric, size from --scale, fixed by known positions of 8 photos",
        ),
        ("gnss", True, {}, "metric, fixed by GNSS fixes of 8 photos"),
        ("dataset", True, {}, "metric, fixed by the poses of the dataset"),
    ],
)
def test_a_summary_says_what_told_size_and_frame(
    built_maps: Path,
    capsys: pytest.CaptureFixture[str],
    kind: Any,
    metric: bool,
    settings: dict[str, Any],
    said: str,
) -> None:
    opened = MapStore(built_maps).open("room")
    manifest = opened.manifest
    anchor = Anchor(kind=kind, images=8)
    world = manifest.world.model_copy(update={"metric": metric, "anchor": anchor})
    method = manifest.method.model_copy(update={"settings": settings})
    manifest = manifest.model_copy(update={"world": world, "method": method})
    assert f"world {said} gravity" in shown(replace(opened, manifest=manifest), capsys)


def test_a_few_stray_landmarks_do_not_make_a_map_large(
    built_maps: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    opened = MapStore(built_maps).open("room")
    usual = shown(opened, capsys).partition("extent ")[2].partition(" m without")[0]
    landmarks = np.array(opened.landmarks)
    landmarks[:3] += 40
    box = opened.manifest.world.extent.model_copy(update={"max": (40.0, 40.0, 40.0)})
    world = opened.manifest.world.model_copy(update={"extent": box})
    manifest = opened.manifest.model_copy(update={"world": world})
    text = shown(replace(opened, manifest=manifest, landmarks=landmarks), capsys)
    sides = [
        np.array(part.split(" x "), float)
        for part in (usual, text.partition("extent ")[2].partition(" m without")[0])
    ]
    assert np.allclose(*sides, rtol=0.05)
    assert " m without the outermost landmarks, 4" in text
