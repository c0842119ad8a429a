"""The commands that make each table of docs/results.md.

A table is the rows that its scripts print, under one header. ``DATA``, ``MAPS`` and ``WORK`` in a
command stand for the folders of the run.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Build:
    """A map that tables are measured in: ``mapping build DATA/dataset/mapping`` with options."""

    dataset: str
    options: Sequence[str] = ()


@dataclass(frozen=True, slots=True)
class Table:
    """How a table is made.

    Attributes:
        runs: by what stands in the first column before the rows that it prints, arguments of
            ``python``. One run without a name adds no column.
        maps: names in ``MAPS`` of the maps that it asks.
    """

    runs: Mapping[str, Sequence[str]]
    maps: Sequence[str] = ()


_SFM = ("--method", "sfm", "--pairs", "distance")
_BARE = ("--method", "retrieval-only")

MAPS: Mapping[str, Build] = {
    "castle": Build("castle", _SFM),
    "castle-bare": Build("castle", _BARE),
    "gardenspoint-bare": Build("gardenspoint", (*_BARE, "--not-metric")),
}


def _ways(dataset: str, *ways: str) -> Table:
    script = ("-m", "benchmarks.map_methods", f"DATA/{dataset}")
    return Table({"": (*script, *ways, "--maps-dir", "WORK/ways")})


def _local_sfm(map_id: str, dataset: str) -> Sequence[str]:
    return ("-m", "benchmarks.local_sfm", "MAPS", map_id, f"DATA/{dataset}/query")


TABLES: Mapping[str, Table] = {
    "without-landmarks": Table(
        {
            "castle, no landmarks": _local_sfm("castle-bare", "castle"),
            "castle, landmarks": _local_sfm("castle", "castle"),
            "gardenspoint by day, no landmarks": _local_sfm("gardenspoint-bare", "gardenspoint"),
        },
        ("castle-bare", "castle", "gardenspoint-bare"),
    ),
    "redkitchen-ways": _ways(
        "redkitchen", "rgbd", "sfm:retrieval", "sfm:distance", "sfm:frustum", "sfm:covisibility"
    ),
    "castle-pairings": _ways(
        "castle", "sfm:distance", "sfm:retrieval", "sfm:frustum", "sfm:covisibility"
    ),
}
