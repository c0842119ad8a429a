"""Local features of one query photo, computed once for all maps that are searched."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from visloc.features import LocalFeatureExtractor
from visloc.features.framing import AS_IT_IS, Framing
from visloc.features.resolution import extract_features, where_counting
from visloc.options import Extraction, LocalizeOptions, ReadAs
from visloc.photos.reading import Photo
from visloc.types import LocalFeatures

# Most keypoints of a query, strongest first. ACCURATE uses as many as the mapping images.
_MOST_KEYPOINTS: Mapping[Extraction, int] = {Extraction.FAST: 1000, Extraction.DEFAULT: 2500}


@dataclass(frozen=True, slots=True, eq=False)
class FoundFeatures:
    """Local features of a photo, kept for the next map that asks for them.

    Attributes:
        local: with keypoints in the stored pixels, of the whole photo. A mask is applied to the
            strongest that a map asks for, so that the maps before it change nothing.
        max_keypoints: the limit that the extractor was given.
        rgb: (height, width, 3) pixels that it read, upright if that was asked for.
    """

    local: LocalFeatures
    max_keypoints: int
    rgb: NDArray[np.uint8]


# The features of one photo, by extractor, settings, and how it was resized and turned.
FeatureCache = dict[tuple[LocalFeatureExtractor, ReadAs, Extraction, Framing], FoundFeatures]


def find_features(
    photo: Photo,
    extractor: LocalFeatureExtractor,
    most: int,
    options: LocalizeOptions,
    found: FeatureCache | None = None,
    framing: Framing = AS_IT_IS,
) -> tuple[LocalFeatures, NDArray[np.uint8]]:
    """Find the local features of a photo, or take them from the cache.

    Args:
        photo: pixels as stored.
        options: the effort and the orientation.
        found: the cache of this photo; new features are added to it.

    Returns:
        Features with keypoints in the stored pixels, where the photo's mask lets them count, and
        the image they were found in.
    """
    most = min(most, _MOST_KEYPOINTS.get(options.extraction, most))
    key = extractor, options.orientation, options.extraction, framing
    known = None if found is None else found.get(key)
    if known is None or known.max_keypoints < most:
        local, rgb = extract_features(
            replace(photo, mask=None),
            extractor,
            max_keypoints=most,
            read_as=options.orientation,
            extraction=options.extraction,
            framing=framing,
        )
        known = FoundFeatures(local, most, rgb)
        if found is not None:
            found[key] = known
    local = known.local if known.max_keypoints == most else known.local.strongest(most)
    return where_counting(photo, local), known.rgb
