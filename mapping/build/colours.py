"""Colours of landmarks, for maps that are to show what a place looks like."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mapping.build.features import Progress
from mapping.build.photos import MappingPhoto
from mapping.build.stages import Item, WorkFolder, key_of
from mapping.cluster.executors import Executor
from visloc.archive import Landmarks

# Raised when the code of the stage changes what comes out.
_REVISION = 1


def landmark_colours(
    work: WorkFolder,
    photos: Sequence[MappingPhoto],
    landmarks: Landmarks,
    workers: Executor,
    progress: Progress,
) -> NDArray[np.uint8]:
    """Return the mean colour (P, 3) RGB of the pixels where the photos see each landmark.

    The mean, because sums of whole numbers need no more memory for more photos and are the same
    in any order; of the two or three photos that see most landmarks a median tells little else.
    A landmark that no photo sees is black. It takes about 100 bytes of memory per landmark.

    Args:
        work: where finished work is kept.
        photos: n photos, those of the landmarks' observations, with their files.
        landmarks: with observations by these photos.
        workers: who reads the photos.
        progress: told how far it is.

    Raises:
        VislocError: what ``MappingPhoto.read`` raises.
    """
    bounds = list(pairwise(landmarks.offsets.tolist()))
    items = [
        _Item(photo, landmarks.keypoints[first:end])
        for photo, (first, end) in zip(photos, bounds, strict=True)
    ]
    workers.run(partial(_sample, work), items, partial(progress, "colours"))
    num = len(landmarks.points)
    sums, counts = np.zeros((3, num), dtype=np.int64), np.zeros(num, dtype=np.int64)
    for item, (first, end) in zip(items, bounds, strict=True):
        observed = landmarks.observed[first:end]  # twice the same, where a photo sees it twice
        np.add.at(counts, observed, 1)
        # NumPy is quick with single columns of one type.
        pixels = work.read(item.key)["rgb"].astype(np.int64)
        for channel, values in zip(sums, pixels.T, strict=True):
            np.add.at(channel, observed, values)
    counts = np.maximum(counts, 1)
    return np.ascontiguousarray(((2 * sums + counts) // (2 * counts)).T, dtype=np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class _Item:
    """A photo and where it sees landmarks: (m, 2) float32 pixels."""

    photo: MappingPhoto
    keypoints: NDArray[np.float32]

    @property
    def key(self) -> str:
        digest = hashlib.sha256(self.keypoints.tobytes()).hexdigest()
        return key_of("colours", _REVISION, photo=self.photo.sha256, keypoints=digest)


def _sample(work: WorkFolder, item: _Item) -> None:
    work.get(item.key, partial(_pixels, item))


def _pixels(item: _Item) -> Item:
    """The pixels (m, 3) that the keypoints lie in."""
    photo = item.photo.read()
    # Coordinates count from the corner of the first pixel. Those of other tools may lie on the far
    # edge or a little beyond.
    last = np.array([photo.width - 1, photo.height - 1])
    x, y = np.clip(np.floor(item.keypoints), 0, last).astype(np.int64).T
    return {"rgb": photo.rgb[y, x]}
