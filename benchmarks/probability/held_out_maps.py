"""A map without some of its photos, as if they had never been taken."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapping.own_test.held_out import vanishing
from visloc.archive import Map
from visloc.retrieval.index import GlobalRows


def without(opened: Map, photos: NDArray[np.int64]) -> Map:
    """Leave out photos (k,) and the landmarks that need them; rows of landmarks stay."""
    if len(photos) == 0:
        return opened
    gone = vanishing(opened, photos)
    kept = np.setdiff1d(np.arange(len(opened.images)), photos)
    offsets = opened.observation_offsets
    rows = np.concatenate([np.arange(offsets[i], offsets[i + 1]) for i in kept])
    landmarks = np.asarray(opened.observation_landmarks)[rows]
    there = ~np.isin(landmarks, gone)
    photo_of_row = np.repeat(np.arange(len(kept)), [offsets[i + 1] - offsets[i] for i in kept])
    counts = np.bincount(photo_of_row[there], minlength=len(kept))
    return replace(
        opened,
        images=tuple(opened.images[i] for i in kept),
        image_poses=opened.image_poses[kept],
        observation_offsets=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        observation_landmarks=landmarks[there],
        observation_descriptors=np.asarray(opened.observation_descriptors)[rows[there]],
        observation_keypoints=np.asarray(opened.observation_keypoints)[rows[there]],
        global_descriptors={
            name: _selected(of, kept) for name, of in opened.global_descriptors.items()
        },
    )


def _selected(rows: GlobalRows, kept: NDArray[np.int64]) -> GlobalRows:
    values: Any = np.ascontiguousarray(rows.values[kept])
    scales = None if rows.scales is None else np.ascontiguousarray(rows.scales[kept])
    return GlobalRows(values, scales)
