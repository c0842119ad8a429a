"""Queries in worker processes: decoding a photo, and passing it on with its features."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import dataclass

from service.values import PackedQuery, Query
from visloc.features import LocalFeatureExtractor
from visloc.localization.query.feature_cache import FeatureCache
from visloc.photos.reading import ImageLimits, Photo, read_photo, with_mask
from visloc.runtime.timing import timed
from visloc.types import MaskedImage, QueryFeatures

# Returns the extractor of local features with this name.
ExtractorOf = Callable[[str], LocalFeatureExtractor]


@dataclass(frozen=True, slots=True, eq=False)
class DecodedQuery:
    """A decoded photo, or the features that were sent instead of it.

    Attributes:
        found: features found in the photo so far.
        seconds: wall time by stage so far.
    """

    query: Photo | QueryFeatures
    found: FeatureCache
    seconds: dict[str, float]


def decode(query: Query, limits: ImageLimits, extractor_of: ExtractorOf) -> DecodedQuery:
    """Decode an encoded photo, or unpack what ``pack`` returned in this service.

    Raises:
        InvalidInput: ``image.*`` or ``mask.size``.
        TooLarge: ``image.too_large``.
    """
    if isinstance(query, PackedQuery):
        photo, found, seconds = pickle.loads(query.data)
        found = {(extractor_of(name), *how): features for (name, *how), features in found.items()}
        return DecodedQuery(photo, found, seconds)
    if isinstance(query, QueryFeatures):
        return DecodedQuery(query, {}, {})
    spent: dict[str, float] = {}
    with timed(spent, "decode"):
        if isinstance(query, MaskedImage):
            photo = with_mask(read_photo(query.image, limits), query.mask, limits)
        else:
            photo = read_photo(query, limits)
    return DecodedQuery(photo, {}, spent)


def pack(decoded: DecodedQuery) -> PackedQuery:
    """Pickle a query for another process. Extractors, which each process has, go by name."""
    found = {
        (extractor.fingerprint.name, *how): features
        for (extractor, *how), features in decoded.found.items()
    }
    parts = decoded.query, found, decoded.seconds
    return PackedQuery(pickle.dumps(parts, pickle.HIGHEST_PROTOCOL))
