"""The commands ``mapping build`` and ``mapping import``."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import typer

from mapping.cli.acceptance import require_acceptance
from mapping.cli.display import (
    ERR,
    OUT,
    print_costs,
    print_import,
    print_map,
    print_pieces,
    say,
    say_peak_memory,
)
from mapping.cli.progress import StageProgress
from mapping.cluster.stage_timings import Costs
from mapping.cluster.storage import is_map_folder, is_remote, open_store, scratch_folder
from mapping.importers import MASKS, ImportSummary, import_dataset, imported, importer_names
from mapping.importers.recognized import refuse_recognized
from mapping.methods.rgbd import DepthSettings
from mapping.methods.sfm_settings import SfmSettings
from mapping.options import (
    SFM_PANEL,
    AcceptOption,
    AnyLocalFeaturesOption,
    ForceOption,
    GlobalFeaturesOption,
    MapsDirOption,
    MaxKeypointsOption,
    WeightsDirOption,
    WorkersOption,
)
from mapping.pipeline.build import build_map
from mapping.pipeline.settings import BuildSettings
from visloc.archive import open_map
from visloc.errors import refuse
from visloc.features import DEFAULT_GLOBAL_FEATURES, DEFAULT_LOCAL_FEATURES

CovisibleInOption = Annotated[
    str | None,
    typer.Option(
        metavar="MAP",
        help="covisibility: pair photos that share points of this map. Default: points of the "
        "dataset.",
        rich_help_panel=SFM_PANEL,
    ),
]


@dataclass(frozen=True, slots=True)
class ImportSettings:
    """The options of ``mapping import``."""

    format_name: Annotated[
        str, typer.Argument(metavar="FORMAT", help=f"One of {', '.join(importer_names())}.")
    ]
    path: Annotated[Path, typer.Argument(help="File or folder in this format.")]
    map_id: Annotated[
        str | None, typer.Option("--map", help="Id of the map to build straight away.")
    ] = None
    output: Annotated[
        Path | None,
        typer.Option("--output", help="Or the dataset to write instead, for mapping build."),
    ] = None
    photos: Annotated[
        Path | None,
        typer.Option(help="Folder that names of photos are relative to. Default: the usual one."),
    ] = None
    metric: Annotated[
        bool | None,
        typer.Option(
            "--metric/--not-metric",
            help="Whether its coordinates are in metres. Default: as the format says.",
        ),
    ] = None
    maps_dir: MapsDirOption = Path("maps")
    local_features: AnyLocalFeaturesOption = DEFAULT_LOCAL_FEATURES
    global_features: GlobalFeaturesOption = DEFAULT_GLOBAL_FEATURES
    weights_dir: WeightsDirOption = None
    max_keypoints: MaxKeypointsOption = 5000
    workers: WorkersOption = 1
    force: ForceOption = False
    accept: AcceptOption = False


def build(settings: BuildSettings, covisible_in: CovisibleInOption = None) -> None:
    """Build a map from a dataset.

    A build that was killed resumes with the same command. The current version of the map stays in
    use until the new one is complete.
    """
    if covisible_in is not None:
        folder = Path(covisible_in)
        if not is_map_folder(covisible_in):
            folder = open_store(settings.maps_dir, settings.cache_dir).folder(covisible_in)
        sfm = replace(settings.sfm, covisible_in=open_map(folder))
        settings = replace(settings, sfm=sfm)
    if not is_remote(settings.dataset):
        refuse_recognized(settings.dataset)
    _build(settings)


def import_(settings: ImportSettings) -> None:
    """Import a reconstruction or photos from another tool, as a dataset or as a map.

    A map is built from imported points (build --method model), else from depth (rgbd), else by
    matching (sfm), with imported poses if there are any. For other choices, import a dataset and
    build from it.
    """
    if (settings.map_id is None) == (settings.output is None):
        raise refuse("import.target", field="--map")
    if settings.output is not None:
        _import_dataset(settings, settings.output)
    if settings.map_id is not None:
        _import_map(settings, settings.map_id)


def _import_dataset(settings: ImportSettings, output: Path) -> None:
    with StageProgress(ERR, if_stopped="nothing was written") as progress:
        summary = import_dataset(
            settings.format_name, settings.path, output, settings.photos, progress
        )
    print_import(summary)
    method, sfm = _method_for(summary)
    options = ["--method", method]
    if sfm.estimate_poses:
        options += ["--poses", "estimate", "--refine", ",".join(sfm.refine)]
    else:  # a dataset cannot say so itself
        metric = summary.metric if settings.metric is None else settings.metric
        options.append("--metric" if metric else "--not-metric")
    if method == "rgbd" and summary.depth_scale != DepthSettings().depth_scale:
        options += ["--depth-scale", f"{summary.depth_scale!r}"]
    if summary.masks:
        options += ["--masks", str(output / MASKS)]
    say(f"dataset: {output}")
    say(f"next: mapping build {output} --map ID {' '.join(options)}")


def _import_map(settings: ImportSettings, map_id: str) -> None:
    with ExitStack() as stack:
        with StageProgress(ERR, if_stopped="nothing was written") as progress:
            dataset, summary = stack.enter_context(
                imported(
                    settings.format_name,
                    settings.path,
                    settings.maps_dir,
                    map_id,
                    settings.photos,
                    progress,
                )
            )
        print_import(summary)
        method, sfm = _method_for(summary)
        _build(
            BuildSettings(
                dataset=dataset,
                map_id=map_id,
                maps_dir=settings.maps_dir,
                method=method,
                local_features=settings.local_features,
                global_features=settings.global_features,
                weights_dir=settings.weights_dir,
                max_keypoints=settings.max_keypoints,
                metric=summary.metric if settings.metric is None else settings.metric,
                sfm=sfm,
                depth=DepthSettings(depth_scale=summary.depth_scale),
                masks=dataset / MASKS if summary.masks else None,
                workers=settings.workers,
                force=settings.force,
                accept=settings.accept,
            )
        )


def _method_for(summary: ImportSummary) -> tuple[str, SfmSettings]:
    """Return the method and settings that suit what was imported."""
    if summary.observations:
        return "model", SfmSettings()
    if summary.depth_maps:
        return "rgbd", SfmSettings()
    if summary.posed:
        return "sfm", SfmSettings()
    # A focal length from EXIF is a start, not a calibration.
    return "sfm", SfmSettings(poses="estimate", refine=("intrinsics",))


def _build(settings: BuildSettings) -> None:
    costs = Costs()
    with StageProgress(ERR) as progress:
        folder = build_map(settings, progress, costs)
    store = open_store(settings.maps_dir, settings.cache_dir)
    print_map(open_map(folder))
    print_pieces(store, open_map(folder))
    print_costs(OUT, costs.table())
    say_peak_memory(costs.table()[-1].spent)
    pictures = scratch_folder(settings.maps_dir, settings.cache_dir, ".doubts")
    require_acceptance(open_map(folder), accept=settings.accept, pictures=pictures)
