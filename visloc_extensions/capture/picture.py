"""The walk from above, with the photos that come back and those that do not."""

from __future__ import annotations

import math
import os
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mapping.frames.plan import Plan
from visloc.archive import Map
from visloc.localization.map_view.constraints import MapGeometry
from visloc_extensions.capture.trying import Trials

_SIDE, _MARGIN, _LEGEND = 1000, 60, 90
_MOST_POINTS = 60_000
_PAPER, _POINT, _WAY, _INK = (255, 255, 255), (215, 215, 215), (140, 140, 140), (40, 40, 40)
# Okabe and Ito's, told apart by all eyes; blue, green, red.
_RIGHT, _WRONG = (115, 158, 0), (0, 94, 213)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
# Landmarks further out than this share are strays.
_STRAYS = 0.01


def draw_walk(opened: Map, trials: Trials, path: Path) -> None:
    """Write a PNG of the map from above; an existing file is replaced."""
    viewpoints = MapGeometry(opened).viewpoints
    plan = Plan.of(opened, viewpoints)
    walk, points = plan.level(viewpoints.centers), plan.level(opened.landmarks.astype(np.float64))
    points = points[:: max(1, len(points) // _MOST_POINTS)]
    shown = np.vstack([np.quantile(points, [_STRAYS, 1 - _STRAYS], axis=0), walk])
    low, extent = shown.min(axis=0), float(np.ptp(shown, axis=0).max()) or 1.0
    zoom = (_SIDE - 2 * _MARGIN) / extent

    def pixels(level: NDArray[np.float64]) -> NDArray[np.int32]:
        x, y = ((level - low) * zoom + _MARGIN).T
        inside = np.clip(np.column_stack([x, _SIDE - y]), -_SIDE, 2 * _SIDE)
        return np.asarray(np.rint(inside), np.int32)

    picture = np.full((_SIDE + _LEGEND, _SIDE, 3), _PAPER, np.uint8)
    for at in pixels(points):
        cv2.circle(picture, (int(at[0]), int(at[1])), 1, _POINT, -1)
    at_photos = pixels(walk)
    sources = [image.name.partition("/")[0] for image in opened.images]
    for here in range(1, len(at_photos)):
        if sources[here] == sources[here - 1]:
            cv2.line(picture, at_photos[here - 1].tolist(), at_photos[here].tolist(), _WAY, 2, 16)
    for image, holds in zip(trials.images.tolist(), trials.right.tolist(), strict=True):
        cv2.circle(picture, at_photos[image].tolist(), 8, _RIGHT if holds else _WRONG, -1, 16)
    _legend(picture, zoom, extent, metric=opened.manifest.world.metric)
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.partial")
    unfinished.write_bytes(cv2.imencode(".png", picture)[1].tobytes())
    unfinished.replace(path)


def _legend(picture: NDArray[np.uint8], zoom: float, extent: float, *, metric: bool) -> None:
    picture[_SIDE:] = _PAPER
    for x, colour, text in (
        (_MARGIN, _RIGHT, "found again"),
        (_MARGIN + 220, _WRONG, "not found"),
    ):
        cv2.circle(picture, (x, _SIDE + 40), 8, colour, -1, 16)
        cv2.putText(picture, text, (x + 18, _SIDE + 46), _FONT, 0.6, _INK, 1, 16)
    length = 10.0 ** math.floor(math.log10(extent / 2))
    length *= 5 if 5 * length <= extent / 2 else (2 if 2 * length <= extent / 2 else 1)
    end = _SIDE - _MARGIN
    cv2.line(picture, (end - round(length * zoom), _SIDE + 40), (end, _SIDE + 40), _INK, 3)
    unit = "m" if metric else "units, size unknown"
    text = f"{length:g} {unit}"
    cv2.putText(picture, text, (end - 11 * len(text), _SIDE + 70), _FONT, 0.6, _INK, 1, 16)
