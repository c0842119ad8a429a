"""Matches of a query with mapping photos that were sent with its features, in place of our own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from visloc.errors import refuse
from visloc.localization.map_view.constraints import MapGeometry
from visloc.matching.correspondences import Pairs, Proposals, proposals_of
from visloc.types import LocalFeatures, QueryFeatures

# A map may round keypoints to steps of a power of two pixels; else they are kept as they were.
_EXACT_PX = 0.01
_NO_MATCHES = np.empty((0, 3))


@dataclass(frozen=True, slots=True, eq=False)
class SentMatches:
    """Matches of one query.

    Attributes:
        local: the query's features.
        by_photo: (k, 3) float64 by the name of a mapping photo: the row of a keypoint of the query,
            and x, y of the keypoint of the photo that it is matched with.
    """

    local: LocalFeatures
    by_photo: Mapping[str, NDArray[np.float64]]

    def propose(self, geometry: MapGeometry, photos: Sequence[int]) -> Proposals:
        """Return the landmarks that photos of a map see at the matched keypoints, best photo first.

        A match with a keypoint that sees no landmark says nothing, and neither does a photo
        without matches.
        """
        return proposals_of([self._pairs(geometry, int(photo)) for photo in photos])

    def _pairs(self, geometry: MapGeometry, photo: int) -> Pairs:
        opened = geometry.opened
        sent = self.by_photo.get(opened.images[photo].name)
        keypoints = opened.keypoints(photo).astype(np.float64)
        if sent is None or not len(sent) or not len(keypoints):
            none = np.empty(0, np.int64)
            return none, none, np.empty(0, np.float32)
        step = opened.manifest.local_features.keypoint_step_px or _EXACT_PX
        away, nearest = cKDTree(keypoints).query(sent[:, 1:])
        there = away <= step  # half a step in x and y is 0.71 steps
        pairs = np.column_stack([sent[there, 0].astype(np.int64), np.asarray(nearest)[there]])
        landmarks, rows = opened.observations(photo)
        placed = np.isfinite(geometry.points(landmarks[pairs[:, 1]])[:, 0])
        i, j = np.unique(pairs[placed], axis=0).T
        scale = np.float32(opened.manifest.local_features.descriptor_scale)
        theirs = rows[j].astype(np.float32) * scale
        similarities = np.einsum("nd,nd->n", self.local.descriptors[i], theirs)
        return i, landmarks[j].astype(np.int64), similarities.astype(np.float32)


def sent_matches(features: QueryFeatures, local: LocalFeatures) -> SentMatches | None:
    """Return the matches that came with features, checked; None when none did."""
    if not features.matches:
        return None
    by_photo = {}
    for name, sent in features.matches.items():
        # A keypoint has one match in a photo. Without a limit, a request of 20 MB could name so
        # many pairs that comparing their descriptors takes gigabytes.
        fits = sent.ndim == 2 and sent.shape[1] == 3 and len(sent) <= len(local)
        with np.errstate(invalid="ignore"):  # signalling NaN
            rows = sent.astype(np.float64) if fits else _NO_MATCHES
        if not fits or not _usable(rows, len(local)):
            raise refuse(
                "features.matches",
                field=f"features.matches.{name[:100]}",
                expected=f"(k, 3), of k up to {len(local)}: a row of the {len(local)} keypoints, "
                "and x, y in the mapping photo",
                got="other numbers" if fits else str(sent.shape),
            )
        by_photo[name] = rows
    return SentMatches(local, by_photo)


def _usable(rows: NDArray[np.float64], num_keypoints: int) -> bool:
    own = rows[:, 0]
    # NaN fails each comparison.
    return bool(
        np.isfinite(rows).all()
        and ((own >= 0) & (own < num_keypoints) & (own == np.floor(own))).all()
    )
