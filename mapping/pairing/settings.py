"""The settings of pairings."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Annotated

import typer

from mapping.options import SFM_PANEL
from visloc.errors import refuse

_option = partial(typer.Option, rich_help_panel=SFM_PANEL)


@dataclass(frozen=True, slots=True, kw_only=True)
class PairSettings:
    """Limits of the pairings, checked when made. Lengths are in the unit of the world."""

    top_k: Annotated[int, _option(min=1, help="Best pairs to keep per photo and pairing.")] = 20
    max_distance: Annotated[
        float, _option(help="distance: largest distance between camera centres, metres.")
    ] = 25.0
    max_angle_deg: Annotated[
        float,
        _option("--max-angle", help="distance: largest angle between orientations, degrees."),
    ] = 45.0
    near: Annotated[float, _option(help="frustum: depth where views begin, metres.")] = 0.5
    far: Annotated[float, _option(help="frustum: depth where views end, metres.")] = 50.0

    def __post_init__(self) -> None:
        length = "a positive number, in the unit of the poses"
        _check("top_k", self.top_k >= 1, "at least 1", self.top_k)
        _check("max_distance", 0 < self.max_distance < math.inf, length, self.max_distance)
        angle = self.max_angle_deg
        _check("max_angle", 0 < angle <= 180, "more than 0 and at most 180 degrees", angle)
        _check("near", 0 < self.near < math.inf, length, self.near)
        above = f"a number above --near {self.near}"
        _check("far", self.near < self.far < math.inf, above, self.far)


def _check(name: str, good: bool, expected: str, got: float) -> None:
    if not good:  # comparisons with NaN are false
        raise refuse(
            f"pairs.{name}", field=f"--{name.replace('_', '-')}", expected=expected, got=got
        )
