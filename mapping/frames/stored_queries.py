"""Photos of a map as queries: what the map keeps of one is asked of a map, without any pixels.

The same functions answer as online. Its own map may be asked, without it, or another one.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from visloc.archive import Map
from visloc.geometry import Pose
from visloc.localization.map_view.constraints import MapGeometry
from visloc.localization.solving import Look, Matches, SeenImage, Solved, solve_instant
from visloc.matching.correspondences import Correspondences, match_landmarks
from visloc.matching.products import EightBitRows
from visloc.options import LocalizeOptions, ReadAs
from visloc.priors import NO_PRIORS
from visloc.types import CameraSource, Evidence


def match_stored(
    source: Map,
    image: int,
    target: MapGeometry,
    photos: Iterable[int],
    without: NDArray[np.integer] | None = None,
    features: NDArray[np.int64] | None = None,
) -> Correspondences:
    """Match the features that a map keeps of a photo with what photos of a map see.

    Args:
        target: of the map that is asked; may be the same.
        without: (k,) landmarks that it is not to have; None for none.
        features: (m,) rows of the photo's features that count; None for all.
    """

    def observed(photo: int) -> tuple[NDArray[np.integer], EightBitRows]:
        landmarks, descriptors = target.observed(photo)
        if without is None:
            return landmarks, descriptors
        there = ~np.isin(landmarks, without)
        return landmarks[there], EightBitRows(descriptors.rows[there], descriptors.scale)

    own_scale = source.manifest.local_features.descriptor_scale
    descriptors = source.observations(image)[1]
    matched = match_landmarks(
        EightBitRows(descriptors if features is None else descriptors[features], own_scale),
        [observed(int(photo)) for photo in photos],
    )
    return matched if features is None else replace(matched, keypoints=features[matched.keypoints])


def solve_stored(
    source: Map,
    image: int,
    geometry: MapGeometry,
    matched: Correspondences,
    options: LocalizeOptions,
) -> Solved:
    """Find the pose of a photo from its matches, relative to the origin of the map asked.

    Args:
        options: thresholds and the seed.
    """
    pixels = source.keypoints(image)[matched.keypoints].astype(np.float64)
    points = geometry.points(matched.landmarks).astype(np.float64)
    evidence = Evidence(
        source.cameras[source.images[image].camera],
        CameraSource.GIVEN,
        1,
        ReadAs.STORED,
        num_keypoints=len(source.observations(image)[0]),
        num_correspondences=len(matched),
    )
    look = Look(evidence, Matches(pixels, points), matched.landmarks, Matches.none())
    seen = SeenImage("camera", Pose.identity(), look)
    return solve_instant([seen], geometry, options, NO_PRIORS)
