"""What a user may choose about pairings."""

from __future__ import annotations

import math
from dataclasses import dataclass

from visloc.errors import refuse


@dataclass(frozen=True, slots=True, kw_only=True)
class PairSettings:
    """Limits of the pairings, checked when made.

    Attributes:
        top_k: best pairs kept of every photo, by each pairing.
        max_distance: between camera centres, in the unit of the world; ``distance`` only.
        max_angle_deg: between camera rotations; ``distance`` only.
        near: depth where views begin, in the unit of the world; ``frustum`` only.
        far: depth where views end; ``frustum`` only.

    Raises:
        InvalidInput: ``pairs.top_k``, ``pairs.max_distance``, ``pairs.max_angle``, ``pairs.near``
            or ``pairs.far``, with the option of the command line as field.
    """

    top_k: int = 20
    max_distance: float = 25.0
    max_angle_deg: float = 45.0
    near: float = 0.5
    far: float = 50.0

    def __post_init__(self) -> None:
        _check("top_k", self.top_k >= 1, "at least 1", self.top_k)
        _check(
            "max_distance",
            0 < self.max_distance < math.inf,
            "a positive number, in the unit of the poses",
            self.max_distance,
        )
        _check(
            "max_angle",
            0 < self.max_angle_deg <= 180,
            "more than 0 and at most 180 degrees",
            self.max_angle_deg,
        )
        _check(
            "near",
            0 < self.near < math.inf,
            "a positive number, in the unit of the poses",
            self.near,
        )
        _check(
            "far", self.near < self.far < math.inf, f"a number above --near {self.near}", self.far
        )


def _check(name: str, good: bool, expected: str, got: float) -> None:
    if not good:  # comparisons with NaN are false
        raise refuse(
            f"pairs.{name}", field=f"--{name.replace('_', '-')}", expected=expected, got=got
        )
