"""The options that several ``mapping`` commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mapping.methods.pairing import PAIRINGS
from visloc.archive import MapStore
from visloc.features import DEFAULT_GLOBAL_FEATURES, global_feature_names, local_feature_names
from visloc.geometry import PixelOrigin
from visloc.types import Fusion, Inference

GLOBAL_DEFAULT = ",".join(DEFAULT_GLOBAL_FEATURES)
RGBD_PANEL, SFM_PANEL, CLUSTER_PANEL = "Method rgbd", "Method sfm", "On a cluster"

DepthSensorOption = Annotated[
    str | None,
    typer.Option(
        help="Depth sensor to use, when several go with a photo.", rich_help_panel=RGBD_PANEL
    ),
]
DepthScaleOption = Annotated[
    float, typer.Option(help="Metres per unit of 16-bit PNG depth.", rich_help_panel=RGBD_PANEL)
]
MapsDirOption = Annotated[
    Path, typer.Option("--maps-dir", envvar="VISLOC_MAPS_DIR", help="Folder of maps.")
]
WeightsDirOption = Annotated[
    Path | None,
    typer.Option(
        "--weights-dir",
        envvar="VISLOC_WEIGHTS_DIR",
        help="Folder with network weights, of features whose weights no package brings "
        "(docs/features.md).",
    ),
]
InferenceOption = Annotated[
    Inference,
    typer.Option(
        help="How networks are computed. torch: the reference, on a CUDA GPU where there is one. "
        "fp32, int8: OpenVINO with 32 or 8 bits. auto: torch where there is a CUDA GPU, else int8 "
        "where the processor is made for it, else fp32. Features of all ways match each other's."
    ),
]
LocalFeaturesOption = Annotated[
    str, typer.Option(help=f"One of {', '.join(local_feature_names())}.")
]
BuildLocalFeaturesOption = Annotated[
    str,
    typer.Option(
        help=f"One of {', '.join(local_feature_names())}, or kapture:TYPE for features that the "
        "dataset brings along."
    ),
]
GlobalFeaturesOption = Annotated[
    str,
    typer.Option(help=f"Comma-separated, of {', '.join(global_feature_names())}, kapture:TYPE."),
]
FusionOption = Annotated[
    Fusion,
    typer.Option(help="How queries fuse several global features, unless they say otherwise."),
]
FusionWeightsOption = Annotated[
    str | None,
    typer.Option(
        metavar="NAME=WEIGHT,...",
        help="How much each global feature counts in that, such as densevlad=1,localvlad=2; those "
        "not named are left out. All count the same when the option is left out.",
    ),
]
FeaturesDirOption = Annotated[
    Path | None,
    typer.Option(help="Where kapture:TYPE features lie, when not in the dataset."),
]
PixelOriginOption = Annotated[
    PixelOrigin,
    typer.Option(
        help="The middle of the first pixel, in the dataset's principal points and in "
        "kapture:TYPE keypoints, is (0.5, 0.5): corner, or (0, 0): center."
    ),
]
MetricOption = Annotated[
    bool | None,
    typer.Option(
        "--metric/--not-metric",
        help="Whether a unit of the dataset's poses is a metre; left out: yes, but no for model.",
    ),
]
WorkersOption = Annotated[
    int,
    typer.Option(
        min=1, max=256, help="Processes that work on photos and pairs; they do not change the map."
    ),
]
MaxKeypointsOption = Annotated[
    int, typer.Option(min=100, max=100_000, help="Strongest keypoints kept per photo.")
]
MapArgument = Annotated[str, typer.Argument(metavar="MAP", help="id, id@version, or a folder.")]
DatasetArgument = Annotated[Path, typer.Argument(help="kapture folder (holds sensors/).")]
# How photos are paired, for build and for pairs.
PairsOption = Annotated[
    str,
    typer.Option(
        help=f"Which photos to match: comma-separated, of {', '.join(PAIRINGS)}.",
        rich_help_panel=SFM_PANEL,
    ),
]
TopKOption = Annotated[
    int,
    typer.Option(
        min=1, help="Best pairs of a photo that each pairing keeps.", rich_help_panel=SFM_PANEL
    ),
]
MaxDistanceOption = Annotated[
    float,
    typer.Option(help="distance: most between camera centres, metres.", rich_help_panel=SFM_PANEL),
]
MaxAngleOption = Annotated[
    float,
    typer.Option(help="distance: most between orientations, degrees.", rich_help_panel=SFM_PANEL),
]
NearOption = Annotated[
    float, typer.Option(help="frustum: where views begin, metres.", rich_help_panel=SFM_PANEL)
]
FarOption = Annotated[
    float, typer.Option(help="frustum: where views end, metres.", rich_help_panel=SFM_PANEL)
]
CovisibleInOption = Annotated[
    str | None,
    typer.Option(
        metavar="MAP",
        help="covisibility: the map that tells; else the dataset's own points.",
        rich_help_panel=SFM_PANEL,
    ),
]


def is_map_folder(ref: str) -> bool:
    """Tell whether a ``MapArgument`` is a folder."""
    return (Path(ref) / "manifest.json").is_file()


def map_folder(ref: str, maps_dir: Path) -> Path:
    """Return the folder that a ``MapArgument`` stands for."""
    return Path(ref) if is_map_folder(ref) else MapStore(maps_dir).folder(ref)
