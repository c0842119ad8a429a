"""Local features of a photo, found in the upright picture: the same for maps and for queries."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from visloc.features import LocalFeatureExtractor
from visloc.features.framing import AS_IT_IS, Framing, turned_picture, unturned_points
from visloc.features.resolution import resized
from visloc.options import Extraction, ReadAs
from visloc.photos.reading import Photo, stored_from_upright, turn_of, upright
from visloc.types import LocalFeatures

# What turning by less than 90 degrees puts beside a picture makes keypoints along its edge.
_EDGE_PX = 4


def extract_features(
    photo: Photo,
    extractor: LocalFeatureExtractor,
    *,
    max_keypoints: int,
    read_as: ReadAs = ReadAs.UPRIGHT,
    extraction: Extraction = Extraction.ACCURATE,
    framing: Framing = AS_IT_IS,
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
        framing: how it is resized before, and turned after that.

    Returns:
        Features with keypoints in the stored pixels, where the photo's mask lets them count, and
        the picture (H, W, 3) that they were found in, which global descriptors are to describe.
    """
    turn = turn_of(photo.exif_orientation) if read_as is ReadAs.UPRIGHT else 1
    width, height = framing.size or (photo.width, photo.height)
    rgb = upright(resized(photo.rgb, width, height), turn)
    if framing.turned == 0:
        local = extractor.extract(rgb, max_keypoints=max_keypoints, extraction=extraction)
    else:
        upright_size = rgb.shape[1], rgb.shape[0]
        rgb = turned_picture(rgb, framing.turned)
        found = extractor.extract(rgb, max_keypoints=max_keypoints, extraction=extraction)
        local = _unturned(found, framing.turned, *upright_size)
    keypoints = stored_from_upright(local.keypoints, turn, width, height)
    if framing.size is not None:
        ratio = np.array([photo.width / width, photo.height / height], np.float32)
        keypoints = keypoints * ratio
        local = replace(local, scales=local.scales * ratio.max())
    return where_counting(photo, replace(local, keypoints=keypoints)), rgb


def where_counting(photo: Photo, local: LocalFeatures) -> LocalFeatures:
    """Drop the features, with keypoints in the stored pixels, that the photo's mask hides."""
    return local if photo.mask is None else local.of(photo.counts(local.keypoints))


def _unturned(found: LocalFeatures, degrees: int, width: int, height: int) -> LocalFeatures:
    """Move features of a turned picture back; those of the edges that turning made are left out."""
    keypoints = unturned_points(found.keypoints, degrees, width, height).astype(np.float32)
    edge = 0 if degrees % 90 == 0 else _EDGE_PX
    inside = (keypoints >= edge) & (keypoints <= [width - edge, height - edge])
    return replace(found, keypoints=keypoints).of(np.asarray(inside.all(axis=1)))
