"""How sharp each frame of a video is, and how far the camera moved, in one pass at low resolution.

Corners are tracked (Lucas and Kanade, pyramids) from a reference frame on; the median of how far
they went, as a share of the longer side, is how far the camera moved. Measured from a reference and
not from frame to frame, trembling hands do not add up. When the corners went far or were lost, the
frame becomes the next reference.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from visloc_extensions.films.video import SHARPNESS_SIDE, Frame, sharpness

_TRACKING_SIDE = 320
_CORNERS, _LEAST_CORNERS = 150, 12
# A new reference when corners moved by so much of the longer side, or so many of them were lost.
_FAR, _LEAST_KEPT = 0.1, 0.5
# What counts as moved where nothing can be tracked from one frame to the next: a jerk or a cut.
_LOST = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """What a pass over a video found, by frame.

    Attributes:
        seconds: (n,) times, increasing.
        sharpness: (n,) variance of the Laplacian of grey levels; comparable among near frames.
        path: (n,) how far the camera moved since the first frame, in longer sides of the picture;
            never decreasing.
    """

    seconds: NDArray[np.float64]
    sharpness: NDArray[np.float64]
    path: NDArray[np.float64]


class _Tracker:
    """Follows corners from a reference frame on."""

    def __init__(self) -> None:
        self._before: NDArray[np.uint8] | None = None
        self._started = self._now = np.empty((0, 2), np.float32)
        self._corners = 0
        self._base = self._path = 0.0

    def step(self, grey: NDArray[np.uint8]) -> float:
        """Take the next frame, and return the path up to it."""
        if self._before is not None:
            self._follow(grey)
        if self._before is None or self._is_used_up(grey):
            self._base = self._path
            found = cv2.goodFeaturesToTrack(grey, _CORNERS, 0.01, 7)
            corners = np.asarray([] if found is None else found, np.float32).reshape(-1, 2)
            self._started = self._now = corners
            self._corners = len(corners)
        self._before = grey
        return self._path

    def _follow(self, grey: NDArray[np.uint8]) -> None:
        assert self._before is not None
        if len(self._now) < _LEAST_CORNERS:  # a bare wall: only its shift as a whole can be seen
            self._path += self._shift_of_all(grey)
            return
        moved, found, _ = cv2.calcOpticalFlowPyrLK(
            self._before, grey, self._now, np.empty_like(self._now), winSize=(21, 21), maxLevel=3
        )
        kept = found.reshape(-1) == 1
        kept &= ((moved >= 0) & (moved < grey.shape[::-1])).all(axis=1)
        if kept.sum() < max(_LEAST_CORNERS, len(self._now) // 4):
            self._path += _LOST
            self._started = self._now = np.empty((0, 2), np.float32)
            return
        self._started, self._now = self._started[kept], moved[kept]
        lengths = np.linalg.norm(self._now - self._started, axis=1)
        self._path = max(self._path, self._base + float(np.median(lengths)) / max(grey.shape))

    def _shift_of_all(self, grey: NDArray[np.uint8]) -> float:
        assert self._before is not None
        window = cv2.createHanningWindow(grey.shape[::-1], cv2.CV_32F)
        shift, response = cv2.phaseCorrelate(
            self._before.astype(np.float32), grey.astype(np.float32), window
        )
        share = float(np.linalg.norm(shift)) / max(grey.shape)
        return min(share, _LOST) if response > 0.05 else 0.0

    def _is_used_up(self, grey: NDArray[np.uint8]) -> bool:
        kept = len(self._now)
        if kept < max(_LEAST_CORNERS, _LEAST_KEPT * self._corners):
            return True
        lengths = np.linalg.norm(self._now - self._started, axis=1)
        return bool(np.median(lengths) > _FAR * max(grey.shape))


def measure_motion(frames: Iterable[Frame]) -> Motion:
    """Measure every frame of a video; one frame is in memory at a time."""
    tracker, rows = _Tracker(), []
    for frame in frames:
        grey = frame.grey(SHARPNESS_SIDE)
        scale = min(1.0, _TRACKING_SIDE / max(grey.shape))
        size = max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale))
        small = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)
        rows.append((frame.seconds, sharpness(grey), tracker.step(small)))
    seconds, sharp, path = np.array(rows, np.float64).reshape(-1, 3).T
    return Motion(seconds, sharp, path)
