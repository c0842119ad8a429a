"""Local features of a photo, found in the upright picture: the same for maps and for queries."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from visloc.features import LocalFeatureExtractor
from visloc.images import Photo, stored_from_upright, turn_of, upright
from visloc.options import Extraction, ReadAs
from visloc.types import LocalFeatures


def extract_features(
    photo: Photo,
    extractor: LocalFeatureExtractor,
    *,
    max_keypoints: int,
    read_as: ReadAs = ReadAs.UPRIGHT,
    extraction: Extraction = Extraction.ACCURATE,
) -> tuple[LocalFeatures, NDArray[np.uint8]]:
    """Find the local features of a photo.

    Learned features tolerate little rotation. So the photo is turned first as its EXIF
    orientation asks for, and the keypoints are moved back. It is never mirrored (``turn_of``).

    Args:
        photo: pixels as stored.
        extractor: finds the features.
        max_keypoints: strongest ones kept, before the mask drops some of them.
        read_as: ``STORED`` to find them without turning the photo.
        extraction: how much effort goes into it.

    Returns:
        Features with keypoints in the stored pixels, where the photo's mask lets them count, and
        the picture (H, W, 3) that they were found in, which global descriptors are to describe.
    """
    turn = turn_of(photo.exif_orientation) if read_as is ReadAs.UPRIGHT else 1
    rgb = photo.rgb if turn == 1 else upright(photo.rgb, turn)
    local = extractor.extract(rgb, max_keypoints=max_keypoints, extraction=extraction)
    keypoints = stored_from_upright(local.keypoints, turn, photo.width, photo.height)
    return where_counting(photo, replace(local, keypoints=keypoints)), rgb


def where_counting(photo: Photo, local: LocalFeatures) -> LocalFeatures:
    """Drop the features, with keypoints in the stored pixels, that the photo's mask hides."""
    if photo.mask is None:
        return local
    counts = photo.counts(local.keypoints)
    return LocalFeatures(
        local.keypoints[counts],
        local.descriptors[counts],
        local.scores[counts],
        local.scales[counts],
    )
