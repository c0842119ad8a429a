"""The settings of an update, which are also the options of ``mapping update``."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from mapping.methods.retrieval_only import RETRIEVAL_ONLY
from mapping.methods.rgbd import DepthSettings
from mapping.options import (
    AcceptOption,
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
from visloc.archive import Map
from visloc.archive.schema import ID_PATTERN
from visloc.errors import refuse
from visloc.geometry import PixelOrigin
from visloc.options import Inference

POSES = ("tie", "given", "localize")
METHODS = ("rgbd", "sfm")


@dataclass(frozen=True, slots=True)
class UpdateSettings:
    """The settings of an update."""

    map_ref: MapArgument
    dataset: DatasetArgument
    maps_dir: MapsDirOption = Path("maps")
    poses: Annotated[
        str,
        typer.Option(
            help="tie: the dataset's poses are in a frame of their own; find where it lies in the "
            "map. given: they are in the map's frame. localize: use the pose at which the map "
            "localizes each photo."
        ),
    ] = POSES[0]
    method: Annotated[
        str | None,
        typer.Option(
            help=f"Source of new landmarks: {' or '.join(METHODS)}. Default: the map's method."
        ),
    ] = None
    capture: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Put NAME/ before the names of the photos, if captures use the same names.",
        ),
    ] = None
    metric: Annotated[
        bool,
        typer.Option(
            "--metric/--not-metric",
            help="Whether the dataset's poses are in metres. If not, the tie finds the scale, and "
            "depth must have the same unit.",
        ),
    ] = True
    features_dir: FeaturesDirOption = None
    pixel_origin: PixelOriginOption = PixelOrigin.CORNER
    weights_dir: WeightsDirOption = None
    inference: InferenceOption = Inference.AUTO
    workers: WorkersOption = 1
    depth_sensor: DepthSensorOption = None
    depth_scale: DepthScaleOption = DepthSettings().depth_scale
    accept: AcceptOption = False


def check_settings(settings: UpdateSettings) -> None:
    """Refuse settings that would fail after long work."""
    for option, value, known in (
        ("poses", settings.poses, POSES),
        ("method", settings.method, METHODS),
    ):
        if value is not None and value not in known:
            raise refuse(f"update.{option}", field=f"--{option}", expected=known, got=value)
    if settings.capture is not None and not ID_PATTERN.fullmatch(settings.capture):
        raise refuse("update.capture", field="--capture", got=settings.capture)
    if not 0 < settings.depth_scale < math.inf:
        raise refuse("update.depth_scale", field="--depth-scale", got=settings.depth_scale)


def method_for(settings: UpdateSettings, opened: Map) -> str:
    """Return the chosen method, or else the map's; a map without landmarks gets none."""
    if not opened.has_landmarks:
        if settings.method is not None:
            raise refuse("map.no_landmarks", field="--method", ref=opened.ref)
        return RETRIEVAL_ONLY
    made_by = opened.manifest.method.name
    method = settings.method or (made_by if made_by in METHODS else "sfm")
    if method == "rgbd" and settings.poses != "tie" and not opened.manifest.world.metric:
        raise refuse("update.unit", field="--poses", got=settings.poses)
    return method


def refuse_strange_settings(opened: Map) -> None:
    """Refuse a map whose recorded settings, which any software may have written, are unusable."""
    settings = opened.manifest.method.settings
    voxel_size = settings.get("voxel_size", 1.0)  # only maps by depth have one
    is_length = (
        isinstance(voxel_size, int | float)
        and not isinstance(voxel_size, bool)
        and 0 < voxel_size < math.inf
    )
    for name, known, expected in (
        ("updates", isinstance(settings.get("updates", []), list), "a list of updates"),
        ("voxel_size", is_length, "a length, more than 0"),
    ):
        if not known:
            raise refuse(
                "update.settings",
                field=name,
                expected=expected,
                got=str(settings[name]),
                ref=opened.ref,
                name=name,
            )


def refuse_few(count: int) -> None:
    """Refuse fewer than two photos, which cannot be matched with each other."""
    if count < 2:
        raise refuse("update.photos_few", field="--method", got=f"{count} to be matched")
