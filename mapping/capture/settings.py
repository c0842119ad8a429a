"""The settings of a capture, which are also the options of ``mapping capture``."""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

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
from visloc.errors import refuse
from visloc.features import DEFAULT_GLOBAL_FEATURES, DEFAULT_LOCAL_FEATURES

_LENGTH = re.compile(r"(\d+(?:\.\d+)?)\s*(mm|cm|m)?", re.IGNORECASE)
_METRES = {"mm": 0.001, "cm": 0.01, "m": 1.0}
_LONGEST_M = 100_000.0


@dataclass(frozen=True, slots=True)
class KnownLength:
    """The distance between where two photos were taken.

    Attributes:
        photos: what names each: a photo's name or its end, or VIDEO@SECONDS.
        metres: positive.
    """

    photos: tuple[str, str]
    metres: float


def metres_in(text: str, field: str) -> float:
    """Read ``3.2m``, ``320 cm`` or ``3.2``, metres.

    Raises:
        InvalidInput: ``capture.length``.
    """
    found = _LENGTH.fullmatch(text.strip())
    metres = float(found[1]) * _METRES[(found[2] or "m").lower()] if found else 0.0
    if not 0 < metres <= _LONGEST_M:
        raise refuse("capture.length", field=field, got=text)
    return metres


def known_length(given: tuple[str, str, str]) -> KnownLength:
    """Read ``--scale``; raises ``capture.length``."""
    first, second, length = given
    return KnownLength((first, second), metres_in(length, "--scale"))


def photo_named(text: str, names: Collection[str]) -> str:
    """Return the photo of this name, or the only one whose name ends so.

    Raises:
        InvalidInput: ``capture.photo``.
    """
    if text in names:
        return text
    ends = [one for one in names if one.endswith(f"/{text}")]
    if len(ends) != 1:
        raise refuse("capture.photo", field="--scale", got=f"{text}: {len(ends)} photos")
    return ends[0]


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
        """The length of ``--scale``.

        Raises:
            InvalidInput: ``capture.length``.
        """
        return None if self.scale is None else known_length(self.scale)

    @property
    def marker_m(self) -> float | None:
        """The side of a marker, metres.

        Raises:
            InvalidInput: ``capture.length``.
        """
        return None if self.marker_size is None else metres_in(self.marker_size, "--marker-size")
