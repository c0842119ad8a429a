"""What ``mapping build`` is told about ranking photos, and ``mapping inspect`` shows of it."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from mapping.cli.main import app
from visloc.archive import MapStore
from visloc.errors import InvalidInput
from visloc.options import Fusion
from visloc.retrieval.fusion import LateFusion


def build(sample: Path, maps_dir: Path, *options: str) -> object:
    result = CliRunner().invoke(
        app,
        [
            *("build", str(sample / "mapping"), "--map", "room", "--maps-dir", str(maps_dir)),
            *("--local-features", "sift", "--max-keypoints", "300", *options),
        ],
        env={"COLUMNS": "200"},
    )
    return result.exception or result.output


def test_a_map_is_built_with_its_default_and_shows_it(sample: Path, tmp_path: Path) -> None:
    shown = build(
        sample, tmp_path, "--fusion", "power", "--fusion-weights", "localvlad = 3, densevlad=0.5"
    )
    expected = LateFusion(Fusion.POWER, {"localvlad": 3.0, "densevlad": 0.5})
    assert MapStore(tmp_path).open("room").fusion == expected
    assert isinstance(shown, str)
    assert "fused by" in shown
    assert "power" in shown
    assert "power, densevlad=0.5, localvlad=3" in shown


def test_inspect_says_nothing_of_the_usual_way(built_maps: Path) -> None:
    result = CliRunner().invoke(app, ["inspect", "room", "--maps-dir", str(built_maps)])
    assert result.exit_code == 0
    assert "fused by" not in result.output


@pytest.mark.parametrize(
    "weights",
    [
        "",
        "localvlad",
        "=1",
        "localvlad=",
        "localvlad=much",
        "localvlad=1,localvlad=2",
        "localvlad=0",
        "localvlad=-1",
        "localvlad=nan",
        "gem=1",
        "localvlad=1,gem=2",
    ],
)
def test_weights_that_mean_nothing_are_refused_before_anything_is_made(
    sample: Path, tmp_path: Path, weights: str
) -> None:
    error = build(sample, tmp_path, "--fusion-weights", weights)
    assert isinstance(error, InvalidInput), error
    assert error.code == "build.fusion_weights"
    assert str(error.field).startswith("--fusion-weights")
    assert not list(tmp_path.iterdir())


def test_an_operator_that_there_is_not_is_wrong_usage(sample: Path, tmp_path: Path) -> None:
    error = build(sample, tmp_path, "--fusion", "borda")
    assert isinstance(error, SystemExit)
    assert error.code == 2
