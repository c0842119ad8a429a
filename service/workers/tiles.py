"""Ranking the tiles of a set by what a photo shows, in worker processes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from service.workers.instants import DecodedQuery, ExtractorOf
from service.workers.set_sequences import SetFrame
from visloc.archive import MapSet, SetOutline, open_map
from visloc.errors import InvalidInput, MapCorrupt
from visloc.features import LocalFeatureExtractor
from visloc.features.framing import Framing
from visloc.features.local.readymade import (
    MAX_READY_MADE_KEYPOINTS,
    is_ready_made,
    to_local_features,
)
from visloc.features.resolution import WorkingResolution
from visloc.localization.map_view.constraints import MapGeometry
from visloc.localization.query.camera import query_resolution, resolve_camera
from visloc.localization.query.feature_cache import FeatureCache, find_features
from visloc.localization.query.fingerprints import check_fingerprint
from visloc.localization.turning import QUARTERS
from visloc.options import LocalizeOptions
from visloc.photos.reading import Photo
from visloc.runtime.threads import timed
from visloc.sets.choosing import TileScore
from visloc.sets.coarse import rank_tiles
from visloc.types import LocalFeatures

# Keypoints with the most effort. Maps have as many by default; a tile that was built with more
# searches the photo again.
_MOST_KEYPOINTS = 5000


def resolution_beside(opened: MapSet, folder: Path) -> WorkingResolution | None:
    """Return how finely the largest tile of a set sees.

    Args:
        opened: the set.
        folder: its version's, ``<id>/<version>`` beside those of its tiles.

    Returns:
        None while that tile of a remote store has no copy here, and when it is damaged, which the
        search of the tile reports.
    """
    largest = max(opened.tiles, key=lambda tile: tile.images)
    path = folder.parent.parent / largest.map / largest.version
    try:
        return MapGeometry(open_map(path)).resolution if path.is_dir() else None
    except MapCorrupt:
        return None


class TileRanker:
    """Ranks the tiles of an open set.

    Args:
        opened: the set.
        extractor_of: returns the extractor of its local features.
        resolution: how finely its tiles see; None to find features in photos of any size.

    Raises:
        Conflict: ``map.features`` when the set's maps were built with other features than those
            that are installed.
    """

    def __init__(
        self, opened: MapSet, extractor_of: ExtractorOf, resolution: WorkingResolution | None
    ) -> None:
        self._set = opened
        self.outline: SetOutline = opened
        self.frame = SetFrame(opened)
        self._resolution = resolution
        self.size_bytes = opened.size_bytes  # without its tiles
        fingerprint = opened.manifest.local_features
        self._extractor = None
        if not is_ready_made(fingerprint.name):
            self._extractor = extractor_of(fingerprint.name)
            check_fingerprint(fingerprint, self._extractor.fingerprint, opened.ref)

    @property
    def kept(self) -> dict[str, object]:
        """What a sequence in the set names instead of carrying it along."""
        return {"outline": self.outline, "frame": self.frame}

    def warm_up(self) -> None:
        """Run once on noise, so that the first query does not pay for the first use."""
        if self._extractor is not None:
            noise = np.random.default_rng(0).integers(0, 255, (480, 640, 3), dtype=np.uint8)
            local, _ = find_features(
                Photo(noise), self._extractor, _MOST_KEYPOINTS, LocalizeOptions()
            )
            rank_tiles(self._set, local, None)

    def rank(
        self, decoded: DecodedQuery, options: LocalizeOptions, allowed: NDArray[np.bool_] | None
    ) -> tuple[TileScore, ...]:
        """Rank tiles by the features of a photo, which ``decoded`` keeps.

        Invalid features rank no tile; the tile that is searched reports the error.

        Args:
            decoded: the query.
            options: how features are found.
            allowed: (T,) the tiles to rank; None to find features only.
        """
        local = self._features(decoded, options)
        if local is None or len(local) == 0 or allowed is None:
            return ()
        with timed(decoded.seconds, "choose_tiles"):
            return rank_tiles(self._set, local, allowed)

    def rank_turned(
        self,
        decoded: DecodedQuery,
        options: LocalizeOptions,
        allowed: NDArray[np.bool_] | None,
        step: Callable[[], None] = lambda: None,
    ) -> tuple[TileScore, ...]:
        """Rank tiles by a photo in all quarter turns, each tile by its best one.

        Args:
            decoded: the query, which keeps the features for the tiles unless its pictures may be
                large. Features that were sent rank no tile.
            options: how features are found.
            allowed: (T,) the tiles to rank; None for none.
            step: called before each turn, it may raise to end the search.
        """
        photo, best = decoded.query, dict[int, float]()
        found = decoded.found if self._resolution is not None else {}
        if not isinstance(photo, Photo) or self._extractor is None or allowed is None:
            return ()
        with timed(decoded.seconds, "turns"):
            for turned in (0, *QUARTERS):
                step()
                local = self._photo_features(photo, self._extractor, found, options, turned)
                for each in rank_tiles(self._set, local, allowed) if len(local) > 0 else ():
                    best[each.tile] = max(each.score, best.get(each.tile, each.score))
        ranked = sorted(best, key=lambda tile: -best[tile])
        return tuple(TileScore(tile, best[tile]) for tile in ranked)

    def _feature_size(self, photo: Photo, turned: int) -> tuple[int, int] | None:
        if self._resolution is None:
            return None
        # The camera that was sent is not known here; a tile to which it matters looks again.
        camera, source = resolve_camera(photo, None)
        resolution = query_resolution(camera, source)
        return self._resolution.feature_size(resolution, photo.width, photo.height, turned)

    def _photo_features(
        self,
        photo: Photo,
        extractor: LocalFeatureExtractor,
        found: FeatureCache,
        options: LocalizeOptions,
        turned: int = 0,
    ) -> LocalFeatures:
        framing = Framing(self._feature_size(photo, turned), turned)
        return find_features(photo, extractor, _MOST_KEYPOINTS, options, found, framing)[0]

    def _features(self, decoded: DecodedQuery, options: LocalizeOptions) -> LocalFeatures | None:
        """Return local features; None for a query that no map of the set takes."""
        query = decoded.query
        if isinstance(query, Photo):
            if self._extractor is None:
                return None
            known, began = len(decoded.found), perf_counter()
            local = self._photo_features(query, self._extractor, decoded.found, options)
            if len(decoded.found) > known:
                decoded.seconds["local_features"] = perf_counter() - began
            return local
        shape, dim = query.keypoints.shape, self._set.coarse.model["vocabulary"].shape[1]
        if (
            query.kind != self._set.manifest.local_features.name
            or shape[1:] != (2,)
            or shape[0] > MAX_READY_MADE_KEYPOINTS
            or query.descriptors.shape != (shape[0], dim)
        ):
            return None
        try:
            return to_local_features(query.keypoints.astype(np.float32), query.descriptors)
        except InvalidInput:
            return None
