"""Options of the commands that localize, and what is made of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from clients.evaluation.benchmark import parse_threshold
from clients.wire.types import LocalizeOptions
from visloc.evaluation import DEFAULT_THRESHOLDS, Threshold
from visloc.geometry import PixelOrigin
from visloc_api.words.options import CHOICES, KINDS


def _named(name: str) -> str:
    return f"{name} ({', '.join(CHOICES[name])})" if name in CHOICES else name


MapRef = Annotated[str, typer.Option("--map", metavar="ID", help="id, or id@version.")]
Options = Annotated[
    list[str] | None,
    typer.Option(
        "--option",
        metavar="NAME=VALUE",
        help=f"{'; '.join(map(_named, KINDS))}. Weights are such as densevlad=1,localvlad=2. "
        "Can be repeated.",
    ),
]
Seed = Annotated[int | None, typer.Option("--seed", min=0, help="The same as --option seed=...")]
Source = Annotated[
    Path,
    typer.Argument(
        metavar="DATASET_OR_LIST",
        help="A kapture folder, or a text file with lines 'image_name' or "
        "'image_name MODEL width height params...', names relative to its folder.",
    ),
]
FeaturesDir = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR",
        help="For a map of ready-made features (kapture:TYPE): the features of the photos, where "
        "they are not in the dataset.",
    ),
]
Origin = Annotated[
    PixelOrigin,
    typer.Option(
        "--pixel-origin",
        help="What the dataset's principal points and ready-made keypoints call the centre of the "
        "top-left pixel: corner, (0.5, 0.5), or center, (0, 0).",
    ),
]
Thresholds = Annotated[
    list[str] | None,
    typer.Option(
        "--threshold",
        metavar="METRES/DEGREES",
        help="What counts as accurate; can be repeated. Without it: 0.05/5, 0.25/2, 0.5/5, 5/10.",
    ),
]


def options_of(texts: Sequence[str] | None, seed: int | None) -> LocalizeOptions:
    """Parse the texts of ``--option`` and ``--seed``.

    Raises:
        InvalidInput: as ``LocalizeOptions.from_texts``.
    """
    return LocalizeOptions.from_texts([*(texts or ()), *([] if seed is None else [f"seed={seed}"])])


def thresholds_of(texts: Sequence[str] | None) -> Sequence[Threshold]:
    """Parse the texts of ``--threshold``.

    Raises:
        InvalidInput: ``evaluation.threshold``.
    """
    return [parse_threshold(text) for text in texts or ()] or DEFAULT_THRESHOLDS
