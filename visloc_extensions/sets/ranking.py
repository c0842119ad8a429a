"""Ranking the tiles of a set by what a photo shows, in worker processes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from service.values import (
    InstantJob,
    Localization,
    PackedSequence,
    PackedSolved,
    Query,
    SequenceJob,
)
from service.workers.instants import DecodedQuery, ExtractorOf, Tools, pack
from service.workers.state import packed, unpacked
from visloc.archive import SetOutline, open_map
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
from visloc.localization.turning import QUARTERS, is_worth_turning
from visloc.options import LocalizeOptions
from visloc.photos.reading import Photo
from visloc.priors import Priors
from visloc.runtime.threads import summed, timed
from visloc.types import LocalFeatures, Refusal
from visloc_extensions.sets.choosing import RankedTiles, TileScore
from visloc_extensions.sets.coarse import rank_tiles
from visloc_extensions.sets.files import MapSet, open_published_set
from visloc_extensions.sets.run import SetFrame, SetRun

# Keypoints with the most effort. Maps have as many by default; a tile that was built with more
# searches the photo again.
_MOST_KEYPOINTS = 5000


def resolution_beside(opened: MapSet, folder: Path) -> WorkingResolution | None:
    """Return how finely the largest tile of a set sees.

    Args:
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
    """An open set in a worker process: it ranks tiles, and puts sequences in order.

    Args:
        extractor_of: returns the extractor of its local features.
        resolution: how finely its tiles see; None to find features in photos of any size.
    """

    def __init__(
        self, opened: MapSet, extractor_of: ExtractorOf, resolution: WorkingResolution | None
    ) -> None:
        self._set = opened
        self.outline: SetOutline = opened
        self.frame = SetFrame(opened)
        # What a sequence in the set names instead of carrying it along.
        self._kept = {"outline": self.outline, "frame": self.frame}
        self._resolution = resolution
        self.size_bytes = opened.size_bytes  # without its tiles
        fingerprint = opened.manifest.local_features
        self._extractor = None
        if not is_ready_made(fingerprint.name):
            self._extractor = extractor_of(fingerprint.name)
            check_fingerprint(fingerprint, self._extractor.fingerprint, opened.ref)

    def warm_up(self) -> None:
        """Run once on noise, so that the first query does not pay for the first use."""
        if self._extractor is not None:
            noise = np.random.default_rng(0).integers(0, 255, (480, 640, 3), dtype=np.uint8)
            local, _ = find_features(
                Photo(noise), self._extractor, _MOST_KEYPOINTS, LocalizeOptions()
            )
            rank_tiles(self._set, local, None)

    def rank_tiles(
        self,
        tools: Tools,
        query: Query,
        options: LocalizeOptions,
        allowed: NDArray[np.bool_] | None,
        submitted: float,
        refused: Refusal | None = None,
    ) -> RankedTiles:
        """Decode a photo, find its features, and rank tiles by them.

        An unusable photo comes back as it is, and ranks no tile. The tiles to rank are ``allowed``
        (T,); None ranks none. If the photo was ``refused`` as it was sent, they are ranked by other
        turns of it, or not at all if no turn can help.
        """
        tools.step()
        seconds = {"queued": max(0.0, tools.began - submitted), "open_map": tools.open_s}
        try:
            decoded = tools.decode(query)
        except InvalidInput:
            return RankedTiles(query)  # the tile that is searched reports the error
        decoded = replace(decoded, seconds=summed(seconds, decoded.seconds))
        if refused is None:
            scores = self.rank(decoded, options, allowed)
        elif is_worth_turning(refused.reason, options):
            scores = self.rank_turned(decoded, options, allowed, tools.step)
        else:
            scores = ()
        return RankedTiles(pack(query, decoded), scores)

    def open_sequence(self, _: Tools, start: SequenceJob) -> PackedSequence:
        return packed(SetRun(start, self.outline, self.frame), self._kept)

    def check_instants(
        self, tools: Tools, sequence: PackedSequence, first: int, instants: Sequence[InstantJob]
    ) -> tuple[PackedSequence, list[Priors], bytes]:
        """Refuse instants that no tile can take.

        Returns:
            The sequence; the priors of the instants; what is known of the cameras.
        """
        run, most = self._run(sequence), tools.settings.max_instants
        priors = [run.check(first + i, instant, most) for i, instant in enumerate(instants)]
        return packed(run, self._kept), priors, run.cameras

    def add_instant(
        self,
        tools: Tools,
        sequence: PackedSequence,
        instant: InstantJob,
        row: int,
        found: Localization,
        solved: PackedSolved,
        priors: Priors,
    ) -> tuple[PackedSequence, list[Localization]]:
        """Take the next instant of a sequence, which the tile of this row solved."""
        tools.step()
        run = self._run(sequence)
        answers = run.add(instant, row, found, solved, priors)
        return packed(run, self._kept), answers

    def finish_sequence(self, _: Tools, sequence: PackedSequence) -> list[Localization]:
        """Return the answers that are still waiting, when no more instants come."""
        return self._run(sequence).finish()

    def _run(self, sequence: PackedSequence) -> SetRun:
        run: SetRun = unpacked(sequence, self._kept)
        return run

    def rank(
        self, decoded: DecodedQuery, options: LocalizeOptions, allowed: NDArray[np.bool_] | None
    ) -> tuple[TileScore, ...]:
        """Rank tiles by the features of a photo, which ``decoded`` keeps.

        Invalid features rank no tile; the tile that is searched reports the error.

        Args:
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


def open_ranker(folder: Path, extractor_of: ExtractorOf) -> TileRanker:
    """Open the set in a folder ``<id>/<version>``; raises as ``TileRanker`` and ``open_set``."""
    opened = open_published_set(folder)
    return TileRanker(opened, extractor_of, resolution_beside(opened, folder))
