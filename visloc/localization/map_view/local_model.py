"""Landmarks of a map that stores none: triangulated around a query when it asks for them.

The photos that a query retrieves are matched with the photos most like each of them, whose poses
are known, and their keypoints are triangulated: local SFM (Humenberger et al. 2020, section 3.3).
What a photo sees depends on the map alone, not on the query, so that equal queries get equal
answers in any order, and a place that was asked before answers at once.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Hashable
from threading import Lock
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from visloc.archive import Map
from visloc.geometry import Pose
from visloc.matching.correspondences import mutual_nearest_neighbours
from visloc.matching.products import EightBitRows, in_threads
from visloc.matching.verification import epipolar_errors
from visloc.pose.reprojection import normalized_rays
from visloc.pose.triangulation import triangulated
from visloc.retrieval.index import retrieve

# Each photo is matched with so many photos that are most like it.
NUM_NEIGHBOURS = 12
# Rays that meet at a smaller angle hardly tell the distance of the point.
MIN_ANGLE = math.radians(1.5)
# Largest reprojection error, in pixels of the photos.
MAX_ERROR_PX = 4.0
# Pairs with fewer matches that agree with their poses show different places, or agree by chance.
_MIN_MATCHES = 15
# How many photos (about 60 kB each) and pairs (about 10 kB each) are kept for further queries.
_KEPT_PHOTOS, _KEPT_PAIRS = 2000, 10_000

Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")
_Matches = tuple[NDArray[np.int64], NDArray[np.int64]]


class _Kept(Generic[Key, Value]):
    """Results that were used last. Safe to use from several threads."""

    def __init__(self, most: int) -> None:
        self._most, self._lock = most, Lock()
        self._values: OrderedDict[Key, Value] = OrderedDict()

    def get(self, key: Key, make: Callable[[Key], Value]) -> Value:
        with self._lock:
            if key in self._values:
                self._values.move_to_end(key)
                return self._values[key]
        value = make(key)  # two threads may make the same; it is equal
        with self._lock:
            self._values[key] = value
            while len(self._values) > self._most:
                self._values.popitem(last=False)
        return value


class LocalModel:
    """The landmarks of a map that stores none. Each observation of a photo is a landmark.

    Args:
        centers: (n, 3) of its photos, relative to its origin.
        rotations: (n, 3, 3) camera from world.
    """

    def __init__(
        self, opened: Map, centers: NDArray[np.float64], rotations: NDArray[np.float64]
    ) -> None:
        self._opened, self._centers, self._rotations = opened, centers, rotations
        self._remaining = np.ones(len(centers))
        self._photos: _Kept[int, NDArray[np.float32]] = _Kept(_KEPT_PHOTOS)
        self._pairs: _Kept[tuple[int, int], _Matches] = _Kept(_KEPT_PAIRS)

    def without(self, photos: NDArray[np.int64]) -> LocalModel:
        """Return what the map would see if it did not have some photos (k,)."""
        model = LocalModel(self._opened, self._centers, self._rotations)
        model._remaining[photos] = 0.0
        model._pairs = self._pairs  # what two photos share does not depend on others
        return model

    def of_photo(self, photo: int) -> NDArray[np.float32]:
        """Return where the observations (m, 3) of a photo are, relative to the map's origin.

        NaN where no other photo tells the distance.
        """
        return self._photos.get(photo, self._triangulated)

    def points(self, landmarks: NDArray[np.integer]) -> NDArray[np.float32]:
        """Return the points (n, 3) of landmarks, which are rows of observations; may be NaN."""
        offsets = self._opened.observation_offsets
        points = np.empty((len(landmarks), 3), np.float32)
        photos = np.searchsorted(offsets, landmarks, side="right") - 1
        for photo in np.unique(photos).tolist():
            own = photos == photo
            points[own] = self.of_photo(photo)[landmarks[own].astype(np.int64) - offsets[photo]]
        return points

    def _triangulated(self, photo: int) -> NDArray[np.float32]:
        pairs = [(min(photo, other), max(photo, other)) for other in self._neighbours(photo)]
        matches = in_threads(lambda pair: self._pairs.get(pair, self._matched), pairs)
        own = self._rays(photo) @ self._rotations[photo]
        rays, views = [own], [photo]
        for (first, second), (i, j) in zip(pairs, matches, strict=True):
            if len(i) < _MIN_MATCHES:
                continue
            other, mine, theirs = (second, i, j) if first == photo else (first, j, i)
            seen = np.full_like(own, np.nan)
            seen[mine] = self._rays(other)[theirs] @ self._rotations[other]
            rays.append(seen)
            views.append(other)
        stacked = np.stack(rays, axis=1)
        points = triangulated(
            stacked / np.linalg.norm(stacked, axis=2, keepdims=True),
            self._centers[views],
            np.array([self._focal_length(view) for view in views]),
            max_error_px=MAX_ERROR_PX,
            min_angle=MIN_ANGLE,
        )
        return points.astype(np.float32)

    def _neighbours(self, photo: int) -> list[int]:
        """Return the other photos most like one, most alike first."""
        index, fusion = self._opened.global_descriptors, self._opened.fusion
        query = {name: index[name][photo] for name in fusion.counted(index)}
        others = self._remaining.copy()
        others[photo] = 0.0
        found: list[int] = retrieve(query, index, NUM_NEIGHBOURS, others, fusion).images.tolist()
        return found

    def _matched(self, pair: tuple[int, int]) -> _Matches:
        """Match two photos; matches that their poses contradict are left out."""
        a, b = pair
        i, j, _ = mutual_nearest_neighbours(self._descriptors(a), self._descriptors(b))
        a_from_world, b_from_world = (
            Pose(self._rotations[photo], -self._rotations[photo] @ self._centers[photo])
            for photo in pair
        )
        errors = epipolar_errors(
            self._rays(a)[i], self._rays(b)[j], b_from_world @ a_from_world.inverse()
        )
        agree = errors * min(map(self._focal_length, pair)) <= MAX_ERROR_PX
        return i[agree], j[agree]

    def _descriptors(self, photo: int) -> EightBitRows:
        scale = self._opened.manifest.local_features.descriptor_scale
        return EightBitRows(self._opened.observations(photo)[1], scale)

    def _rays(self, photo: int) -> NDArray[np.float64]:
        camera = self._opened.cameras[self._opened.images[photo].camera]
        return normalized_rays(camera, self._opened.keypoints(photo))

    def _focal_length(self, photo: int) -> float:
        return self._opened.cameras[self._opened.images[photo].camera].focal_length
