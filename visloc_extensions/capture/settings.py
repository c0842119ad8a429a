"""The settings of a capture, which are also the options of ``mapping capture``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from mapping.frames.known_length import KnownLength, known_length, metres_in
from mapping.options import (
    AcceptOption,
    ForceOption,
    GlobalFeaturesOption,
    LocalFeaturesOption,
    MapsDirOption,
    MaxKeypointsOption,
    WeightsDirOption,
    WorkersOption,
)
from visloc.features import DEFAULT_GLOBAL_FEATURES, DEFAULT_LOCAL_FEATURES


@dataclass(frozen=True, slots=True)
class CaptureSettings:
    """The sources and options of a capture."""

    sources: Annotated[
        list[Path],
        typer.Argument(
            metavar="SOURCE...",
            help="Videos (MP4, MOV, WebM), folders of photos and videos, or scans of Polycam, "
            "Record3D, Stray Scanner and others (also transforms.json), all of one place.",
        ),
    ]
    map_id: Annotated[str, typer.Option("--map", help="Id of the map.")]
    maps_dir: MapsDirOption = Path("maps")
    photos: Annotated[
        int, typer.Option(min=2, max=5000, help="At most so many frames of each video.")
    ] = 200
    scale: Annotated[
        tuple[str, str, str] | None,
        typer.Option(
            metavar="PHOTO PHOTO LENGTH",
            help="Distance between where two photos were taken, such as walk.mp4@2 walk.mp4@9 "
            "3.2m. A photo is a name, or VIDEO@SECONDS.",
        ),
    ] = None
    marker_size: Annotated[
        str | None,
        typer.Option(
            metavar="LENGTH",
            help="Side of the black square of printed ArUco or AprilTag markers, such as 16cm.",
        ),
    ] = None
    local_features: LocalFeaturesOption = DEFAULT_LOCAL_FEATURES
    global_features: GlobalFeaturesOption = DEFAULT_GLOBAL_FEATURES
    weights_dir: WeightsDirOption = None
    max_keypoints: MaxKeypointsOption = 5000
    workers: WorkersOption = 1
    accept: AcceptOption = False
    force: ForceOption = False

    @property
    def known_length(self) -> KnownLength | None:
        """The length of ``--scale``."""
        return None if self.scale is None else known_length(self.scale)

    @property
    def marker_m(self) -> float | None:
        """The side of a marker, metres."""
        return None if self.marker_size is None else metres_in(self.marker_size, "--marker-size")
