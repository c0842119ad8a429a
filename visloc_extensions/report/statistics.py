"""Histograms of what a map holds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from visloc.archive import Map

_TRACK_EDGES = (1, 2, 3, 4, 5, 6, 8, 11, 16, 21, 31, 51, 101)
_NUM_BINS = 20
_PERCENT = 99.5  # the rest is so far out that all else would be one bar
_BLOCK = 4_000_000

Histogram = dict[str, list[float] | list[int]]


def statistics_of(opened: Map) -> dict[str, Any]:
    """Count a map's landmarks, as ``statistics`` of web/src/report/data.ts."""
    longest = int(opened.track_lengths.max())
    edges = [edge for edge in _TRACK_EDGES if edge <= longest] + [longest + 1]
    return {
        "track_length": _histogram(opened.track_lengths, edges),
        "error_px": _measured(opened.errors_px),
        "angle_deg": _measured(opened.angles_deg),
        "landmarks_per_image": _evenly(np.diff(opened.observation_offsets)),
    }


def _measured(values: NDArray[np.floating]) -> Histogram | None:
    """A histogram of those that are known; None where none are."""
    known = np.asarray(values[np.isfinite(values)], dtype=np.float32)
    return _evenly(known) if len(known) else None


def _evenly(values: NDArray[Any]) -> Histogram:
    """A histogram of equal bars from 0; the last holds all that lies beyond it."""
    high = float(np.percentile(values, _PERCENT))
    step = _round_step(max(high, 1e-3) / _NUM_BINS)
    count = max(1, int(np.ceil(high / step)))
    return _histogram(np.minimum(values, step * count), [step * i for i in range(count + 1)])


def _round_step(least: float) -> float:
    """The smallest of 1, 2, 5 times a power of ten that is no smaller."""
    power = 10.0 ** np.floor(np.log10(least))
    return float(
        next(power * factor for factor in (1, 2, 5, 10) if power * factor >= least * 0.999)
    )


def _histogram(values: NDArray[Any], edges: Sequence[float]) -> Histogram:
    counts = np.zeros(len(edges) - 1, dtype=np.int64)
    for start in range(0, len(values), _BLOCK):
        counts += np.histogram(values[start : start + _BLOCK], edges)[0]
    return {"edges": [round(float(edge), 6) for edge in edges], "counts": counts.tolist()}
