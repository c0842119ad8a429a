"""Colours of landmarks, for pictures of a map."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mapping.stages.context import BuildContext
from mapping.stages.photos import MappingPhoto
from mapping.stages.work_folder import Item, WorkFolder, key_of
from visloc.archive import Landmarks

# Raised when the code of the stage changes what comes out.
_REVISION = 1


def landmark_colours(
    context: BuildContext, photos: Sequence[MappingPhoto], landmarks: Landmarks
) -> NDArray[np.uint8]:
    """Return the mean colour (P, 3) RGB of the pixels where the photos see each landmark.

    A mean of whole numbers does not depend on the order of the photos, and its memory does not grow
    with them. A median would add little for landmarks that two or three photos see. A landmark that
    no photo sees is black. It takes about 100 bytes of memory per landmark.

    Args:
        photos: the n photos that observe the landmarks, with their files.
    """
    bounds = list(pairwise(landmarks.offsets.tolist()))
    items = [
        _Item(photo, landmarks.keypoints[first:end])
        for photo, (first, end) in zip(photos, bounds, strict=True)
    ]
    context.run("colours", partial(_sample, context.work), items)
    num = len(landmarks.points)
    sums, counts = np.zeros((3, num), dtype=np.int64), np.zeros(num, dtype=np.int64)
    for item, (first, end) in zip(items, bounds, strict=True):
        observed = landmarks.observed[first:end]  # may name a landmark twice
        np.add.at(counts, observed, 1)
        # np.add.at is fast for single columns of one type only.
        pixels = context.work.read(item.key)["rgb"].astype(np.int64)
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
    """Return the pixels (m, 3) that contain the keypoints."""
    photo = item.photo.read()
    # Coordinates count from the corner of the first pixel. Those of other tools may lie on the far
    # edge or a little beyond.
    last = np.array([photo.width - 1, photo.height - 1])
    x, y = np.clip(np.floor(item.keypoints), 0, last).astype(np.int64).T
    return {"rgb": photo.rgb[y, x]}
