"""A picture of a map from above, with the photos that its own test speaks of."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from visloc.archive import Map
from visloc.localization.map_view.constraints import MapGeometry

_SIDE, _MARGIN = 1000, 40
_GROUND, _LANDMARK, _PHOTO, _DOUBTED = (
    (255, 255, 255),
    (205, 205, 205),
    (170, 110, 30),
    (40, 40, 220),
)
_MAX_LANDMARKS = 100_000
# Few landmarks lie far outside, and would make everything else small.
_SHOWN_SHARE = 0.02


def draw_doubts(opened: Map) -> bytes:
    """Draw the landmarks and the photos of a map from above, those in doubt in red.

    Above is against gravity; where that is unknown, the plane is that in which the photos lie.

    Returns:
        A PNG of 1000 x 1000 pixels.
    """
    viewpoints = MapGeometry(opened).viewpoints
    centers = np.array([viewpoints.pose(row).center for row in range(len(opened.images))])
    doubted = {name for doubt in opened.manifest.parts.doubts for name in doubt.photos}
    plane = _plane(opened, centers)
    step = max(1, len(opened.landmarks) // _MAX_LANDMARKS)
    points = (opened.landmarks[::step].astype(np.float64)) @ plane.T
    places = centers @ plane.T
    inner = np.quantile(points, [_SHOWN_SHARE, 1 - _SHOWN_SHARE], axis=0)
    low = np.minimum(inner[0], places.min(axis=0))
    high = np.maximum(inner[1], places.max(axis=0))
    scale = (_SIDE - 2 * _MARGIN) / max(float((high - low).max()), 1e-9)
    canvas = np.full((_SIDE, _SIDE, 3), _GROUND, np.uint8)
    pixels = np.rint((points - low) * scale + _MARGIN).astype(np.int64)
    inside = ((pixels >= 0) & (pixels < _SIDE)).all(axis=1)
    canvas[_SIDE - 1 - pixels[inside, 1], pixels[inside, 0]] = _LANDMARK
    in_doubt = [image.name in doubted for image in opened.images]
    for row in np.argsort(in_doubt, kind="stable"):  # those in doubt on top
        x, y = np.rint((places[row] - low) * scale + _MARGIN).astype(int).tolist()
        color = _DOUBTED if in_doubt[row] else _PHOTO
        cv2.circle(canvas, (x, _SIDE - 1 - y), 6, color, cv2.FILLED, cv2.LINE_AA)
    return cv2.imencode(".png", canvas)[1].tobytes()


def _plane(opened: Map, centers: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return two axes (2, 3) to look along from above."""
    if opened.gravity is None:
        return np.asarray(np.linalg.svd(centers - centers.mean(axis=0))[2][:2])
    down = np.asarray(opened.gravity, np.float64)
    return np.asarray(np.linalg.svd(down[None])[2][1:])
