"""The command line that is made from settings."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import pytest
import typer
from typer.testing import CliRunner

from mapping.cli.build import ImportSettings
from mapping.cli.from_settings import from_settings
from mapping.cli.maps import AnchorSettings
from mapping.cluster.workers import DEFAULT_WORKERS
from mapping.methods.rgbd import DepthSettings
from mapping.methods.sfm_settings import SfmSettings
from mapping.options import Names, OnCommandLine
from mapping.pairing import PairSettings
from mapping.pipeline.pairs import PairsJob
from mapping.pipeline.settings import BuildSettings
from visloc.geometry import PixelOrigin
from visloc.options import Fusion, Inference


def read_by(command: Any, *arguments: str) -> Any:
    """Run a command of these options alone."""
    app = typer.Typer()
    app.command()(from_settings(command))
    outcome = CliRunner().invoke(app, arguments)
    if outcome.exit_code:
        raise outcome.exception or AssertionError(outcome.output)
    return outcome


def settings_of(kind: type, *arguments: str) -> Any:
    """The settings that the command line of a dataclass gives."""
    given = []

    def command(settings: Any) -> None:
        given.append(settings)

    command.__annotations__["settings"] = kind
    read_by(command, *arguments)
    return given[0]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("data", "--map", "m"), BuildSettings(Path("data"), "m", workers=DEFAULT_WORKERS)),
        (("data", "--output", "p"), PairsJob(Path("data"), Path("p"))),
        (("nvm", "a.nvm"), ImportSettings("nvm", Path("a.nvm"), workers=DEFAULT_WORKERS)),
        (("m",), AnchorSettings("m")),
    ],
    ids=lambda value: type(value).__name__,
)
def test_options_left_out_give_the_defaults(
    arguments: tuple[str, ...], expected: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("MAPS_DIR", "WEIGHTS_DIR", "CACHE_DIR"):
        monkeypatch.delenv(f"VISLOC_{name}", raising=False)
    assert settings_of(type(expected), *arguments) == expected


def test_every_option_of_a_build_reaches_its_field() -> None:
    options = (
        "data --map m --maps-dir maps2 --method sfm --local-features sift --global-features a,b "
        "--fusion mean --fusion-weights a=1,b=2 --features-dir f --pixel-origin center "
        "--weights-dir w --inference fp32 --max-keypoints 200 --not-metric --gravity 0,0,-2 "
        "--keep-photos --keep-colours --workers 3 --executor ray --ray-address local "
        "--work-dir work --cache-dir cache --force --voxel-size 0.5 --depth-sensor d "
        "--depth-scale 0.25 --pairs distance,frustum --top-k 7 --max-distance 8 --max-angle 9 "
        "--near 1 --far 2 --pairs-file p.txt --mapper config2 --refine poses,points "
        "--poses estimate"
    )
    assert settings_of(BuildSettings, *options.split()) == BuildSettings(
        dataset=Path("data"),
        map_id="m",
        maps_dir=Path("maps2"),
        method="sfm",
        local_features="sift",
        global_features=("a", "b"),
        fusion=Fusion.MEAN,
        fusion_weights={"a": 1.0, "b": 2.0},
        features_dir=Path("f"),
        pixel_origin=PixelOrigin.CENTER,
        weights_dir=Path("w"),
        inference=Inference.FP32,
        max_keypoints=200,
        metric=False,
        gravity=(0.0, 0.0, -2.0),
        keep_photos=True,
        keep_colours=True,
        workers=3,
        executor="ray",
        ray_address="local",
        work_dir=Path("work"),
        cache_dir=Path("cache"),
        force=True,
        depth=DepthSettings(voxel_size=0.5, depth_scale=0.25),
        depth_sensor="d",
        sfm=SfmSettings(
            pairs=("distance", "frustum"),
            pairing=PairSettings(top_k=7, max_distance=8.0, max_angle_deg=9.0, near=1.0, far=2.0),
            pairs_file=Path("p.txt"),
            mapper="config2",
            refine=("poses", "points"),
            poses="estimate",
        ),
    )


@dataclass(frozen=True)
class Inner:
    depth: Annotated[float, typer.Option(help="How deep.")] = 1.5
    not_an_option: object = None


@dataclass(frozen=True)
class Outer:
    inner: Inner = field(default_factory=Inner)
    names: Annotated[Names, typer.Option(help="Which.")] = ("a", "b")
    count: Annotated[int, typer.Option(min=2, help="How many."), OnCommandLine(default=4)] = 3


def test_nested_settings_and_plain_options_make_one_command_line() -> None:
    given = []

    def command(settings: Outer, word: Annotated[str, typer.Option(help="Another.")] = "w") -> None:
        given.append((settings, word))

    read_by(command)
    read_by(command, "--depth", "2", "--names", " x, y ", "--count", "5", "--word", "v")
    read_by(command, "--names", "")
    assert given == [
        (Outer(count=4), "w"),
        (Outer(Inner(2.0), ("x", "y"), 5), "v"),
        (Outer(names=(), count=4), "w"),
    ]
    shown = read_by(command, "--help").output
    for part in ("--names", "[default: a,b]", "[default: 4]", "How deep.", "x>=2"):
        assert part in shown
    assert "not-an-option" not in shown
