"""The size of a map, from the known distance between where two of its photos were taken."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import JsonValue

from visloc.errors import refuse

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
    """Read ``3.2m``, ``320 cm`` or ``3.2``, metres."""
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
    """Return the photo of this name, or the only one whose name ends so."""
    if text in names:
        return text
    ends = [one for one in names if one.endswith(f"/{text}")]
    if len(ends) != 1:
        raise refuse("capture.photo", field="--scale", got=f"{text}: {len(ends)} photos")
    return ends[0]


# Centres nearer together than this, of the extent of all, tell no scale.
_LEAST_SHARE = 1e-3


@dataclass(frozen=True, slots=True)
class Scale:
    """Metres in a unit of the map.

    Attributes:
        metres: per unit; None when it could not be told.
        note: where it is from, or why there is none.
    """

    metres: float | None
    note: str
    record: Mapping[str, JsonValue]


def scale_of_length(
    first: str, second: str, metres: float, centers: Mapping[str, NDArray[np.float64]]
) -> Scale:
    """Return the scale that the distance between two photos tells, of their centres by name."""
    absent = [name for name in (first, second) if name not in centers]
    if absent:
        return Scale(None, f"no scale: {absent[0]} of --scale found no place in the map", {})
    units = float(np.linalg.norm(centers[first] - centers[second]))
    if units <= _LEAST_SHARE * float(np.ptp(np.array([*centers.values()]), axis=0).max()):
        return Scale(None, "no scale: the photos of --scale were taken at one place", {})
    record: dict[str, JsonValue] = {"by": "length", "photos": [first, second], "metres": metres}
    return Scale(metres / units, f"scale: {first} and {second} are {metres:g} m apart", record)
