"""What worker processes do to search a set of maps: read a photo once, rank tiles by it."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from service.values import Query, ReadQuery
from visloc.archive import MapSet
from visloc.errors import InvalidInput
from visloc.features import LocalFeatureExtractor
from visloc.features.local.readymade import (
    MAX_READY_MADE_KEYPOINTS,
    is_ready_made,
    to_local_features,
)
from visloc.images import ImageLimits, Photo, read_photo
from visloc.localization.feature_cache import FeatureCache, find_features
from visloc.localization.fingerprints import check_fingerprint
from visloc.sets.choosing import TileScore
from visloc.sets.coarse import rank_tiles
from visloc.timing import timed
from visloc.types import LocalFeatures, LocalizeOptions, QueryFeatures

# Keypoints with the most effort. Maps are made with as many unless they are told otherwise; one
# that was made with more has the photo's features found again.
_MOST_KEYPOINTS = 5000

ExtractorOf = Callable[[str], LocalFeatureExtractor]


class TileChooser:
    """Ranks the tiles of a set by what a photo shows.

    Args:
        opened: the set.
        extractor_of: gives the extractor of local features by name.

    Raises:
        Conflict: ``map.features`` when the set's maps were built with other features than those at
            hand.
    """

    def __init__(self, opened: MapSet, extractor_of: ExtractorOf) -> None:
        self.map_set = opened
        fingerprint = opened.manifest.local_features
        self._extractor = None
        if not is_ready_made(fingerprint.name):
            self._extractor = extractor_of(fingerprint.name)
            check_fingerprint(fingerprint, self._extractor.fingerprint, opened.ref)

    @property
    def ref(self) -> str:
        """The set, ``id@version``."""
        return self.map_set.ref

    @property
    def size_bytes(self) -> int:
        """Of the set's own files."""
        return self.map_set.size_bytes

    def warm_up(self) -> None:
        """Run once on noise, so that the first query does not pay for the first use."""
        if self._extractor is not None:
            noise = np.random.default_rng(0).integers(0, 255, (480, 640, 3), dtype=np.uint8)
            local, _ = find_features(
                Photo(noise), self._extractor, _MOST_KEYPOINTS, LocalizeOptions()
            )
            rank_tiles(self.map_set, local, None)

    def choose(
        self, read: Read, options: LocalizeOptions, allowed: NDArray[np.bool_] | None
    ) -> tuple[TileScore, ...]:
        """Find the features of a photo, and rank tiles by them; note in ``read`` what was found.

        What cannot be used ranks nothing: the tile that is asked then says what is wrong with it.

        Args:
            read: the photo, or what was found in it.
            options: how features are found.
            allowed: (T,) the tiles to rank; None to rank none.
        """
        local = self._features(read, options)
        if local is None or len(local) == 0 or allowed is None:
            return ()
        with timed(read.seconds, "choose_tiles"):
            return rank_tiles(self.map_set, local, allowed)

    def _features(self, read: Read, options: LocalizeOptions) -> LocalFeatures | None:
        """Return local features; None for what no map of the set takes."""
        if isinstance(read.query, Photo):
            if self._extractor is None:
                return None
            known = len(read.found)
            began = perf_counter()
            local, _ = find_features(
                read.query, self._extractor, _MOST_KEYPOINTS, options, read.found
            )
            if len(read.found) > known:
                read.seconds["local_features"] = perf_counter() - began
            return local
        keypoints, descriptors = read.query.keypoints, read.query.descriptors
        dim = self.map_set.coarse.model["vocabulary"].shape[1]
        if (
            read.query.kind != self.map_set.manifest.local_features.name
            or len(keypoints) > MAX_READY_MADE_KEYPOINTS
            or keypoints.shape != (len(keypoints), 2)
            or descriptors.shape != (len(keypoints), dim)
        ):
            return None
        try:
            return to_local_features(keypoints.astype(np.float32), descriptors)
        except InvalidInput:
            return None


@dataclass(frozen=True, slots=True, eq=False)
class Read:
    """A photo, or what was found in it, and what is known of it so far.

    Attributes:
        query: decoded.
        found: features of the photo.
        seconds: wall time by stage that went into it.
    """

    query: Photo | QueryFeatures
    found: FeatureCache
    seconds: dict[str, float]


def read_query(query: Query, limits: ImageLimits, extractor_of: ExtractorOf) -> Read:
    """Read a query, encoded or read before by a process of this service.

    Args:
        query: the photo, or what was found in it.
        limits: on encoded photos.
        extractor_of: gives the extractor of local features by name.

    Raises:
        InvalidInput: ``image.*``.
        TooLarge: ``image.too_large``.
    """
    seconds: dict[str, float] = {}
    if isinstance(query, ReadQuery):
        read, found, seconds = pickle.loads(query.data)
        return Read(
            read,
            {(extractor_of(name), *how): features for (name, *how), features in found.items()},
            seconds,
        )
    if isinstance(query, QueryFeatures):
        return Read(query, {}, seconds)
    with timed(seconds, "decode"):
        photo = read_photo(query, limits)
    return Read(photo, {}, seconds)


def written(read: Read) -> ReadQuery:
    """Write down what was read for another process, which has extractors of its own."""
    found = {
        (extractor.fingerprint.name, *how): features
        for (extractor, *how), features in read.found.items()
    }
    parts = read.query, found, read.seconds
    return ReadQuery(pickle.dumps(parts, pickle.HIGHEST_PROTOCOL))


def summed(*parts: Mapping[str, float]) -> dict[str, float]:
    """Add up wall times by stage, in the order in which stages are named first."""
    total: dict[str, float] = {}
    for part in parts:
        for stage, seconds in part.items():
            total[stage] = total.get(stage, 0.0) + seconds
    return total
