"""The settings of a build, which are also the options of ``mapping build``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from mapping.cluster.executors import LOCAL
from mapping.cluster.storage import place_of
from mapping.methods.retrieval_only import RETRIEVAL_ONLY
from mapping.methods.rgbd import DepthSettings
from mapping.methods.sfm_settings import SfmSettings
from mapping.options import (
    CLUSTER_PANEL,
    AcceptOption,
    AnyLocalFeaturesOption,
    CacheDirOption,
    DepthSensorOption,
    FeaturesDirOption,
    ForceOption,
    GlobalFeaturesOption,
    Gravity,
    InferenceOption,
    MaxKeypointsOption,
    OnCommandLine,
    PixelOriginOption,
    PlacedDatasetArgument,
    PlacedMapsDirOption,
    WeightsDirOption,
    WorkersOption,
    names_in,
)
from visloc.errors import refuse
from visloc.features import DEFAULT_GLOBAL_FEATURES, DEFAULT_LOCAL_FEATURES
from visloc.geometry import PixelOrigin
from visloc.options import Fusion, Inference
from visloc.retrieval.fusion import LateFusion
from visloc.retrieval.index import MAX_EXACT, IndexKind

_cluster_option = partial(typer.Option, rich_help_panel=CLUSTER_PANEL)

METHODS = ("rgbd", "sfm", "model", RETRIEVAL_ONLY)


def _weights_in(text: str) -> Mapping[str, float]:
    items = [item.rpartition("=") for item in names_in(text)]
    try:
        weights = {name.strip(): float(weight) for name, _, weight in items}
    except ValueError:
        weights = {}
    if not weights or len(weights) < len(items) or "" in weights:
        raise refuse(
            "build.fusion_weights",
            "these are not weights of global features",
            field="--fusion-weights",
            expected="NAME=WEIGHT,... such as densevlad=1,localvlad=2, each name once",
            got=text,
        )
    return weights


@dataclass(frozen=True, slots=True)
class BuildSettings:
    """The settings of a build. Folders may be URLs where their help says so."""

    dataset: PlacedDatasetArgument
    map_id: Annotated[str, typer.Option("--map", help="Id of the map.")]
    maps_dir: PlacedMapsDirOption = Path("maps")
    method: Annotated[
        str,
        typer.Option(
            help="Source of the landmarks. rgbd: depth maps. sfm: triangulated matches. model: "
            "points that come with the dataset. retrieval-only: none; queries triangulate around "
            "themselves."
        ),
    ] = METHODS[0]
    local_features: AnyLocalFeaturesOption = DEFAULT_LOCAL_FEATURES
    global_features: GlobalFeaturesOption = DEFAULT_GLOBAL_FEATURES
    fusion: Annotated[
        Fusion,
        typer.Option(help="How to fuse several global features. A query may choose another way."),
    ] = Fusion.GHARM
    fusion_weights: Annotated[
        Mapping[str, float] | None,
        typer.Option(
            metavar="NAME=WEIGHT,...",
            help="Weight of each global feature in the fusion, such as densevlad=1,localvlad=2. "
            "Features without a weight are not used. Default: equal weights.",
        ),
        OnCommandLine(_weights_in),
    ] = None
    index: Annotated[
        IndexKind,
        typer.Option(
            help="How queries search the photos of the map. flat: all are compared. ivf: the most "
            f"similar by an inverted file. auto: ivf for more than {MAX_EXACT} photos."
        ),
    ] = IndexKind.AUTO
    features_dir: FeaturesDirOption = None
    pixel_origin: PixelOriginOption = PixelOrigin.CORNER
    weights_dir: WeightsDirOption = None
    inference: InferenceOption = Inference.AUTO
    max_keypoints: MaxKeypointsOption = 5000
    metric: Annotated[
        bool | None,
        typer.Option(
            "--metric/--not-metric",
            # A reconstruction has the unit that its tool chose.
            help="Whether the dataset's poses are in metres. Default: yes, except for --method "
            "model.",
        ),
    ] = None
    gravity: Annotated[
        Gravity,
        typer.Option(
            metavar="X,Y,Z",
            help="Vector of any length that points down in the map's frame, such as 0,0,-1 where "
            "z is up. A map anchored to GNSS does not need it.",
        ),
    ] = None
    masks: Annotated[
        Path | None,
        typer.Option(
            help="Folder of masks: that of the photo a/b.jpg is a/b.jpg.png, of the same size, and "
            "black where there is what moves or mirrors. No landmarks are made there.",
        ),
    ] = None
    keep_photos: Annotated[
        bool,
        typer.Option(
            "--keep-photos",
            help="Store a small copy of each photo in the map (at most 640 pixels), for localize "
            "--debug. Without this option nobody can see the photos in the map.",
        ),
    ] = False
    keep_colours: Annotated[
        bool,
        typer.Option(
            "--keep-colours",
            help="Store the colours of the landmarks in the map, for the web page and the report. "
            "The colours of an imported model are always stored.",
        ),
    ] = False
    accept: AcceptOption = False
    workers: WorkersOption = 1
    executor: Annotated[
        str,
        _cluster_option(
            help="Where the workers run. local: on this machine. ray: on a Ray cluster."
        ),
    ] = LOCAL
    ray_address: Annotated[
        str,
        _cluster_option(
            metavar="ADDRESS",
            help="Address of the cluster: HOST:PORT or ray://HOST:PORT. auto: the cluster of "
            "RAY_ADDRESS or of this machine. local: a new one on this machine, which ends with "
            "the build.",
        ),
    ] = "auto"
    work_dir: Annotated[
        Path | None,
        _cluster_option(
            metavar="FOLDER|URL",
            help="Where to keep finished work until the map is published, in .work/MAP. All "
            "machines must share it. Default: --maps-dir.",
        ),
        OnCommandLine(partial(place_of, option="--work-dir")),
    ] = None
    cache_dir: CacheDirOption = Path("maps-cache")
    force: ForceOption = False
    depth: DepthSettings = field(default_factory=DepthSettings)
    depth_sensor: DepthSensorOption = None
    sfm: SfmSettings = field(default_factory=SfmSettings)

    @property
    def late_fusion(self) -> LateFusion:
        """How queries fuse the global features by default."""
        return LateFusion(self.fusion, self.fusion_weights)

    @property
    def poses_are_metric(self) -> bool:
        """Whether a unit of the dataset's poses is a metre."""
        return self.method != "model" if self.metric is None else self.metric
