"""Which frames of a video become photos: the sharpest of each stretch of the camera's way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visloc_extensions.capture.motion import Motion

# Photos nearer together than this, in longer sides of the picture, show the same. Cameras that walk
# straight ahead move little in the picture, and need them as dense.
_LEAST_STEP = 0.02
# Below this share of the median of the frames within so many seconds, a frame is blurred.
_BLURRED, _NEIGHBOURS_S = 0.4, 2.0
# Photos further apart than this may not connect: a blurred one between them is better than none.
_MOST_GAP = 0.15
_ROUNDS = 40


@dataclass(frozen=True, slots=True, eq=False)
class ChosenFrames:
    """The frames that become photos, and why others do not.

    Attributes:
        rows: (k,) of the frames, increasing.
        blurred: (n,) frames that are much less sharp than those around them.
    """

    rows: NDArray[np.int64]
    blurred: NDArray[np.bool_]


def choose_frames(motion: Motion, most: int, wanted_s: Sequence[float] = ()) -> ChosenFrames:
    """Choose at most so many frames, and those nearest to wanted times.

    The way is cut into equal stretches, as short as the number allows, and the sharpest frame of
    each is taken. Where the camera stands still, one frame stands for all.

    Args:
        motion: of n frames.
        most: frames, beside those that are wanted.
        wanted_s: seconds from the first frame.
    """
    blurred = motion.sharpness < _BLURRED * _usual_sharpness(motion)
    stretches = _stretches(motion.path, most)
    # By stretch, then sharpness; the last of each stretch is its sharpest.
    order = np.lexsort((motion.sharpness, stretches))
    ends = np.flatnonzero(np.diff(stretches[order], append=stretches[-1:] + 1))
    rows = _without_blurred(np.sort(order[ends]), motion.path, blurred)
    wanted = [int(np.argmin(np.abs(motion.seconds - second))) for second in wanted_s]
    return ChosenFrames(np.union1d(rows, np.array(wanted, np.int64)), blurred)


def _stretches(path: NDArray[np.float64], most: int) -> NDArray[np.int64]:
    """The number (n,) of each frame's stretch; at most so many distinct ones."""
    low, high = _LEAST_STEP, max(_LEAST_STEP, float(path[-1]) + _LEAST_STEP)

    def cut(step: float) -> NDArray[np.int64]:
        return np.floor(path / step).astype(np.int64)

    if len(np.unique(cut(low))) <= most:
        return cut(low)
    for _ in range(_ROUNDS):  # shorter stretches, by halving the interval
        step = (low + high) / 2
        if len(np.unique(cut(step))) > most:
            low = step
        else:
            high = step
    return cut(high)


def _usual_sharpness(motion: Motion) -> NDArray[np.float64]:
    """The median (n,) of the sharpness of the frames around each."""
    starts = np.searchsorted(motion.seconds, motion.seconds - _NEIGHBOURS_S)
    ends = np.searchsorted(motion.seconds, motion.seconds + _NEIGHBOURS_S, side="right")
    return np.array([np.median(motion.sharpness[a:b]) for a, b in zip(starts, ends, strict=True)])


def _without_blurred(
    rows: NDArray[np.int64], path: NDArray[np.float64], blurred: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """Leave out blurred frames whose neighbours among the chosen still overlap."""
    kept: list[int] = []
    for place, row in enumerate(rows.tolist()):
        after = rows[place + 1] if place + 1 < len(rows) else None
        if (
            not blurred[row]
            or not kept
            or after is None
            or path[after] - path[kept[-1]] > _MOST_GAP
        ):
            kept.append(row)
    return np.array(kept, np.int64)
