"""GNSS fixes of a map's captures, kept as they were recorded (``gnss.json``)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, FiniteFloat, model_validator

from visloc.archive.checks import read_record
from visloc.archive.schema import Record

GNSS_FILE = "gnss.json"
# About 90 MB. A larger file could not be read again (``read_record``).
MAX_FIXES = 500_000


# A dataclass takes a third of the memory of a pydantic model, and a receiver may tell millions.
@dataclass(frozen=True, slots=True)
class GnssFix:
    """One fix, with the numbers of kapture's ``records_gnss.txt``.

    Attributes:
        timestamp: in the unit of the photos' timestamps.
        x: longitude in degrees for EPSG:4326, otherwise easting.
        y: latitude in degrees for EPSG:4326, otherwise northing.
        z: altitude in metres.
        utc: Unix time in seconds, 0 when unknown.
        dop: dilution of precision, 0 when unknown.
    """

    timestamp: Annotated[int, Field(ge=-(2**63), lt=2**63)]
    receiver: Annotated[str, Field(max_length=1000)]
    x: FiniteFloat
    y: FiniteFloat
    z: FiniteFloat
    utc: FiniteFloat
    dop: FiniteFloat


class Fixes(Record):
    """``gnss.json``. ``receivers`` has the parameters of each, of which the first is the system."""

    receivers: dict[str, tuple[str, ...]]
    fixes: tuple[GnssFix, ...]

    @model_validator(mode="after")
    def _is_consistent(self) -> Fixes:
        if not {fix.receiver for fix in self.fixes} <= self.receivers.keys():
            raise ValueError("a fix is of a receiver that is not listed")
        if len({(fix.timestamp, fix.receiver) for fix in self.fixes}) < len(self.fixes):
            raise ValueError("two fixes are of one receiver and time")
        return self

    def joined(self, other: Fixes) -> Fixes:
        """Return the fixes of both; receivers of one name that contradict each other are two."""
        known = {(fix.timestamp, fix.receiver): fix for fix in self.fixes}
        renamed = {
            name: name if self._fits(name, other, known) else self._free(name, other)
            for name in other.receivers
        }
        more = (replace(fix, receiver=renamed[fix.receiver]) for fix in other.fixes)
        return Fixes(
            receivers={
                **self.receivers,
                **{renamed[name]: params for name, params in other.receivers.items()},
            },
            # What both have of one receiver and time is the same, and one.
            fixes=tuple({**known, **{(fix.timestamp, fix.receiver): fix for fix in more}}.values()),
        )

    def thinned(self, most: int = MAX_FIXES) -> Fixes:
        """Return at most so many fixes: of more, every second, third and so on of each receiver."""
        if len(self.fixes) <= most:
            return self
        ordered = sorted(self.fixes, key=lambda fix: (fix.receiver, fix.timestamp))
        return self.model_copy(update={"fixes": tuple(ordered[:: -(-len(ordered) // most)])})

    def _fits(self, name: str, other: Fixes, known: dict[tuple[int, str], GnssFix]) -> bool:
        if name in self.receivers and self.receivers[name] != other.receivers[name]:
            return False
        own = (fix for fix in other.fixes if fix.receiver == name)
        return all(known.get((fix.timestamp, name), fix) == fix for fix in own)

    def _free(self, name: str, other: Fixes) -> str:
        number = 2
        while f"{name}-{number}" in self.receivers or f"{name}-{number}" in other.receivers:
            number += 1
        return f"{name}-{number}"


def read_fixes(folder: Path, files: Mapping[str, Any]) -> Fixes | None:
    """Return the fixes that a map keeps; None for a map without any.

    Args:
        folder: the map's folder.
        files: the files that the map's manifest lists, by name.
    """
    return read_record(folder, GNSS_FILE, Fixes) if GNSS_FILE in files else None
