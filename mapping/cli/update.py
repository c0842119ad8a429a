"""The command ``mapping update``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from mapping.cli.options import (
    DatasetArgument,
    DepthScaleOption,
    DepthSensorOption,
    FeaturesDirOption,
    InferenceOption,
    MapArgument,
    MapsDirOption,
    PixelOriginOption,
    WeightsDirOption,
    WorkersOption,
)
from mapping.cli.progress import StageProgress
from mapping.cluster.workers import DEFAULT_WORKERS
from mapping.maps.updating.job import Updated, update_map
from mapping.maps.updating.settings import METHODS, POSES, UpdateSettings
from mapping.methods.rgbd import DepthSettings
from visloc.archive import open_map
from visloc.geometry import PixelOrigin
from visloc.types import Inference

_DEPTH_SCALE = DepthSettings().depth_scale

_out = Console()
_err = Console(stderr=True)


def update(
    map_ref: MapArgument,
    dataset: DatasetArgument,
    maps_dir: MapsDirOption = Path("maps"),
    poses: Annotated[
        str,
        typer.Option(
            help="tie: the dataset's, in a frame of its own, which is tied to the map. given: the "
            "dataset's, in the map's frame. localize: where the map localizes each photo."
        ),
    ] = POSES[0],
    method: Annotated[
        str | None,
        typer.Option(
            help=f"Where new landmarks come from: {' or '.join(METHODS)}; left out: as the map's."
        ),
    ] = None,
    capture: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Put NAME/ before the names of the photos, where captures have the same names.",
        ),
    ] = None,
    metric: Annotated[
        bool,
        typer.Option(
            "--metric/--not-metric",
            help="Whether a unit of the dataset's poses is a metre; if not, the tie finds "
            "it, and depth must have the same unit.",
        ),
    ] = True,
    features_dir: FeaturesDirOption = None,
    pixel_origin: PixelOriginOption = PixelOrigin.CORNER,
    weights_dir: WeightsDirOption = None,
    inference: InferenceOption = Inference.AUTO,
    workers: WorkersOption = DEFAULT_WORKERS,
    depth_sensor: DepthSensorOption = None,
    depth_scale: DepthScaleOption = _DEPTH_SCALE,
) -> None:
    """Add a new capture to a map, without building it again.

    A new version is published; the old one stays. A capture of another place is refused. Killed at
    any moment, the same command resumes.
    """
    settings = UpdateSettings(
        dataset=dataset,
        map_ref=map_ref,
        maps_dir=maps_dir,
        poses=poses,
        method=method,
        capture=capture,
        metric=metric,
        depth_scale=depth_scale,
        depth_sensor=depth_sensor,
        features_dir=features_dir,
        pixel_origin=pixel_origin,
        weights_dir=weights_dir,
        inference=inference,
        workers=workers,
    )
    with StageProgress(_err) as progress:
        updated = update_map(settings, progress)
    print_update(_out, updated)


def print_update(out: Console, updated: Updated) -> None:
    """Show how well a capture fits the map that it joined."""
    opened, record = open_map(updated.folder), updated.record
    unit = "m" if opened.manifest.world.metric else "units"

    def say(text: str) -> None:
        out.print(text, markup=False, highlight=False, soft_wrap=True)

    say(
        f"capture {record.capture}: {record.photos} photos, {record.observations} observations, "
        f"{record.landmarks} new landmarks ({record.method})"
    )
    absent = ", ".join(f"{count} {reason}" for reason, count in record.not_localized.items())
    say(
        f"localized {record.localized} of {record.tried} photos that were tried"
        + (f" (not: {absent})" if absent else "")
    )
    if record.poses == "localize":
        say(f"median residual of the localized photos: {record.pixels:.2f} px")
    else:
        say(
            f"{record.tied} photos tied, median residual {record.pixels:.2f} px, "
            f"{record.position:.4g} {unit}, {record.orientation_deg:.3g} degrees; "
            f"scale {record.scale:.6g}"
        )
    counts = opened.manifest.counts
    say(
        f"map {opened.ref}: {counts.images} photos, {counts.landmarks} landmarks, "
        f"{counts.observations} observations"
    )
    for note in updated.notes:
        say(f"note: {note}")
