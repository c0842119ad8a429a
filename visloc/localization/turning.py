"""Find the turn in which a map knows a photo, if its camera was held turned and EXIF is silent.

Local features tolerate rolls of about 30 degrees. Looking at every turn as thoroughly as at the
photo itself would multiply the time of each hopeless photo. A cheap test tells whether a turn is
worth it: the clear matches of the strongest keypoints with the most similar mapping photos
(docs/decisions/0036-turned-cameras.md).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
from numpy.typing import NDArray

from visloc.features import GlobalDescriptor, LocalFeatureExtractor
from visloc.features.framing import Framing
from visloc.localization.map_view.constraints import Constraints, MapGeometry
from visloc.localization.query.camera import query_resolution
from visloc.localization.query.feature_cache import FeatureCache, find_features
from visloc.matching.correspondences import CLEAR_RATIO, propose_landmarks
from visloc.matching.products import round_descriptors
from visloc.options import LocalizeOptions, ReadAs
from visloc.photos.reading import Photo, turn_of, upright_from_stored
from visloc.pose.gravity import KnownGravity
from visloc.priors import Priors
from visloc.retrieval.index import retrieve
from visloc.types import Evidence, LocalFeatures, Reason

# The usual refusals of a turned photo.
REASONS_OF_TURNED_PHOTOS = (
    *(Reason.TOO_FEW_MATCHES, Reason.NO_POSE, Reason.TOO_FEW_INLIERS, Reason.LOW_INLIER_RATIO),
)
# In a symmetric room, a photo that is upside down gets a wrong pose.
_WORTH_TURNING = (*REASONS_OF_TURNED_PHOTOS, Reason.UNCERTAIN_POSE, Reason.UNLIKELY_POSE)
# Degrees clockwise. 135 and 225 are left out: a camera is hardly held upside down and askew.
QUARTERS, _ASKEW = (90, 180, 270), (45, 315)
_ALL = (*QUARTERS, *_ASKEW)
_STEP_DEG = 45
_NUM_KEYPOINTS, _NUM_PHOTOS = 1000, 3
# A turn is worth a try if it has this many clear matches with one photo, this many times as many as
# come by chance, and more than the photo as it was.
_LEAST_CLEAR, _TIMES_BY_CHANCE = 20, 2.0
# Askew turns are looked at only if the turns so far promise by this factor: a photo that is held
# askew already matches a little when it is off by 45 degrees.
_TIMES_NEXT_TO_IT = 1.5
# With so many clear matches, no other turn is looked at.
_SURELY_CLEAR = 100
# Least part of gravity (a unit vector) across the optical axis. With less, it tells no roll.
_LEAST_ACROSS = 0.4


class TurnFinder:
    """Looks for the turn in which a map knows photos.

    Args:
        descriptors: its global descriptors that can be computed, by name.
    """

    def __init__(
        self,
        geometry: MapGeometry,
        extractor: LocalFeatureExtractor,
        descriptors: Mapping[str, GlobalDescriptor],
    ) -> None:
        self._geometry, self._extractor = geometry, extractor
        opened = geometry.opened
        # Those that are made of local features come nearly for free.
        cheap = {name: d for name, d in descriptors.items() if not d.needs_image}
        self._descriptors = cheap or descriptors
        self._index = {name: opened.global_descriptors[name] for name in self._descriptors}

    def find(
        self,
        photo: Photo,
        evidence: Evidence,
        reason: Reason,
        options: LocalizeOptions,
        priors: Priors,
        cache: FeatureCache,
        step: Callable[[], None] = lambda: None,
    ) -> int:
        """Return by how many degrees clockwise to turn a refused photo; 0 when no turn promises.

        Args:
            photo: pixels as stored.
            options: those of the query.
            priors: gravity tells the turn, and others exclude mapping photos.
            cache: features of this photo; those of the turns are added.
            step: called before each look, it may raise to end the search.
        """
        if not self._descriptors or not is_worth_turning(reason, options):
            return 0
        constraints = Constraints(self._geometry, priors)
        turns = _turns_by(constraints.gravity, photo)
        resolution = query_resolution(evidence.camera, evidence.camera_source)
        seen_as = partial(
            self._geometry.resolution.feature_size, resolution, photo.width, photo.height
        )

        def clear(turned: int) -> int:
            step()
            most = self._geometry.opened.manifest.local_features.max_keypoints
            size = seen_as(turned)
            framing = Framing(size, turned)
            local, rgb = find_features(photo, self._extractor, most, options, cache, framing)
            return self._clear_matches(local.strongest(_NUM_KEYPOINTS), rgb, constraints)

        if not turns:
            return 0
        counts = {0: clear(0)}
        for turned in turns:
            if turned in _ASKEW and turns is _ALL and not _promises(counts, _TIMES_NEXT_TO_IT):
                break
            counts[turned] = clear(turned)
            if counts[turned] >= _SURELY_CLEAR:
                break
        return turn_that_promises(counts)

    def _clear_matches(
        self, local: LocalFeatures, rgb: NDArray[np.uint8], constraints: Constraints
    ) -> int:
        """Count the clear matches with the mapping photo that has most of them."""
        if len(local) == 0:
            return 0
        opened = self._geometry.opened
        query = {
            name: descriptor.describe(rgb, local, opened.global_models[name])
            for name, descriptor in self._descriptors.items()
        }
        retrieved = retrieve(query, self._index, _NUM_PHOTOS, constraints.photo_weights)
        pairs = propose_landmarks(
            round_descriptors(local.descriptors),
            (self._geometry.observed(row) for row in retrieved.images),
            CLEAR_RATIO,
        )
        return int(np.bincount(pairs.ranks, minlength=1).max())


def is_worth_turning(reason: Reason, options: LocalizeOptions) -> bool:
    """Tell whether a photo that was refused for this reason is to be looked at in other turns."""
    return options.read_as is ReadAs.ANY and reason in _WORTH_TURNING


def turn_that_promises(counts: Mapping[int, int]) -> int:
    """Return the turn that is worth a second try; 0 when none is.

    Args:
        counts: clear matches by turn, also of the photo as it was (0).
    """
    promises = _promises(counts, _TIMES_BY_CHANCE)
    return max(counts, key=lambda turned: counts[turned]) if promises else 0


def _promises(counts: Mapping[int, int], times: float) -> bool:
    """Tell whether the best turn has so many times as many clear matches as come by chance."""
    # Most turns show nothing of the map, so the lower half of the counts is chance. If a surely
    # clear turn ended the search early, it is not in that half.
    by_chance = sorted(counts.values())[max(0, len(counts) // 2 - 1)]
    return max(counts.values()) >= max(_LEAST_CLEAR, times * by_chance)


def _turns_by(gravity: KnownGravity | None, photo: Photo) -> tuple[int, ...]:
    """Return the turns to look at: the one that gravity tells, else all."""
    if gravity is None or np.linalg.norm(gravity.rig[:2]) < _LEAST_ACROSS:
        return _ALL
    size = photo.width, photo.height
    ends = np.array([[0.0, 0.0], gravity.rig[:2]])
    start, end = upright_from_stored(ends, turn_of(photo.exif_orientation), *size)
    x, y = end - start
    # Turned clockwise by this, (x, y) points down.
    turned = int(np.round(np.degrees(np.arctan2(x, y)) / _STEP_DEG)) * _STEP_DEG % 360
    return (turned,) if turned else ()
