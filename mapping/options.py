"""The options that commands share, as types.

Settings are frozen dataclasses whose fields carry their option:
``Annotated[type, typer.Option(help=...)]``. ``mapping.cli.from_settings`` makes the command line of
them, so a name, a default and a sentence of help stand in one place.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from mapping.cluster.storage import place_of
from mapping.cluster.workers import DEFAULT_WORKERS
from visloc.errors import refuse
from visloc.features import global_feature_names, local_feature_names
from visloc.geometry import PixelOrigin
from visloc.options import Inference

RGBD_PANEL, SFM_PANEL, CLUSTER_PANEL = "Method rgbd", "Method sfm", "On a cluster"
MAPS_DIR_VARIABLE = "VISLOC_MAPS_DIR"

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class OnCommandLine:
    """How an option differs from the field that it sets.

    Attributes:
        parse: makes the field's value of the option's text; None where Typer does it.
        write: makes the text of the field's default.
        default: of the option; None for the field's own.
    """

    parse: Callable[[str], Any] | None = None
    write: Callable[[Any], str] = str
    default: Any = None


def names_in(text: str) -> tuple[str, ...]:
    """Split names at commas; no name in an empty text."""
    return tuple(name.strip() for name in text.split(",")) if text.strip() else ()


def gravity_in(text: str) -> Vector:
    """Read ``X,Y,Z``."""
    try:
        x, y, z = (float(number) for number in text.split(","))
    except ValueError:
        raise refuse("build.gravity", field="--gravity", got=text) from None
    return x, y, z


Names = Annotated[tuple[str, ...], OnCommandLine(names_in, ",".join)]
Gravity = Annotated[Vector | None, OnCommandLine(gravity_in)]

MapArgument = Annotated[str, typer.Argument(metavar="MAP", help="id, id@version, or a folder.")]
DatasetArgument = Annotated[Path, typer.Argument(help="kapture folder (holds sensors/).")]
PlacedDatasetArgument = Annotated[
    Path,
    typer.Argument(help="kapture folder (holds sensors/), or its URL."),
    OnCommandLine(partial(place_of, option="dataset")),
]
MapsDirOption = Annotated[
    Path, typer.Option("--maps-dir", envvar=MAPS_DIR_VARIABLE, help="Folder of maps.")
]
PlacedMapsDirOption = Annotated[
    Path,
    typer.Option("--maps-dir", envvar=MAPS_DIR_VARIABLE, help="Folder of maps, or its URL."),
    OnCommandLine(partial(place_of, option="--maps-dir")),
]
CacheDirOption = Annotated[
    Path,
    typer.Option(
        envvar="VISLOC_CACHE_DIR",
        help="Folder for local copies of maps, if --maps-dir is a URL.",
        rich_help_panel=CLUSTER_PANEL,
    ),
]
ForceOption = Annotated[
    bool, typer.Option("--force", help="Publish a new version of a map that exists.")
]
AcceptOption = Annotated[
    bool,
    typer.Option(
        "--accept", help="Put the new version into use even if its own test speaks against it."
    ),
]
WorkersOption = Annotated[
    int,
    typer.Option(
        min=1,
        max=256,
        help="Worker processes for photos and pairs. Their number does not change the map.",
    ),
    OnCommandLine(default=DEFAULT_WORKERS),
]
WeightsDirOption = Annotated[
    Path | None,
    typer.Option(
        "--weights-dir",
        envvar="VISLOC_WEIGHTS_DIR",
        help="Folder of network weights that no package ships (docs/features.md).",
    ),
]
InferenceOption = Annotated[
    Inference,
    typer.Option(
        help="How to run networks. torch: the reference, on a CUDA GPU if there is one. fp32, "
        "int8: OpenVINO with 32 or 8 bits. auto: torch on a CUDA GPU, else int8 on a processor "
        "with 8-bit instructions, else fp32. Features match across all of these."
    ),
]
MaxKeypointsOption = Annotated[
    int, typer.Option(min=100, max=100_000, help="Strongest keypoints to keep per photo.")
]
LocalFeaturesOption = Annotated[
    str, typer.Option(help=f"One of {', '.join(local_feature_names())}.")
]
AnyLocalFeaturesOption = Annotated[
    str,
    typer.Option(
        help=f"One of {', '.join(local_feature_names())}, or kapture:TYPE for features in the "
        "dataset."
    ),
]
GlobalFeaturesOption = Annotated[
    Names,
    typer.Option(help=f"Comma-separated: {', '.join(global_feature_names())}, kapture:TYPE."),
]
FeaturesDirOption = Annotated[
    Path | None,
    typer.Option(help="Folder of kapture:TYPE features. Default: the dataset."),
]
PixelOriginOption = Annotated[
    PixelOrigin,
    typer.Option(
        help="Coordinates of the centre of the first pixel, in the dataset's principal points and "
        "kapture:TYPE keypoints. corner: (0.5, 0.5). center: (0, 0)."
    ),
]
DepthSensorOption = Annotated[
    str | None,
    typer.Option(
        help="Depth sensor to use if a photo has several depth maps.", rich_help_panel=RGBD_PANEL
    ),
]
DepthScaleOption = Annotated[
    float,
    typer.Option(help="Metres per unit of 16-bit PNG depth maps.", rich_help_panel=RGBD_PANEL),
]
