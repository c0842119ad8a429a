"""Local features of a photo, found in the upright picture: the same for maps and for queries."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from visloc.features import LocalFeatureExtractor
from visloc.features.resolution import resized
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
    size: tuple[int, int] | None = None,
) -> tuple[LocalFeatures, NDArray[np.uint8]]:
    """Find the local features of a photo.

    Learned features tolerate little rotation. So the photo is turned first as its EXIF
    orientation asks for, and the keypoints are moved back. It is never mirrored (``turn_of``).

    Args:
        photo: pixels as stored.
        extractor: finds the features.
        max_keypoints: strongest ones kept.
        read_as: ``STORED`` to find them without turning the photo.
        extraction: how much effort goes into it.
        size: width and height to which the stored pixels are resized first; None to leave them.

    Returns:
        Features with keypoints in the stored pixels, where the photo's mask lets them count, and
        the picture (H, W, 3) that they were found in, which global descriptors are to describe.
    """
    turn = turn_of(photo.exif_orientation) if read_as is ReadAs.UPRIGHT else 1
    width, height = size or (photo.width, photo.height)
    rgb = upright(resized(photo.rgb, width, height), turn)
    local = extractor.extract(rgb, max_keypoints=max_keypoints, extraction=extraction)
    keypoints = stored_from_upright(local.keypoints, turn, width, height)
    if size is not None:
        ratio = np.array([photo.width / width, photo.height / height], np.float32)
        keypoints = keypoints * ratio
        local = replace(local, scales=local.scales * ratio.max())
    local = replace(local, keypoints=keypoints)
    if photo.mask is not None:
        counts = photo.counts(keypoints)
        local = LocalFeatures(
            keypoints[counts], local.descriptors[counts], local.scores[counts], local.scales[counts]
        )
    return local, rgb
