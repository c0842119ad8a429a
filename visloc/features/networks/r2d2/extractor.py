"""Finds keypoints with R2D2 or Fast-R2D2 at several scales of a photo."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from visloc.features.base import Fingerprint
from visloc.features.local.subpixel import peak_offsets
from visloc.features.networks.r2d2.architecture import DESCRIPTOR_DIM
from visloc.options import Extraction
from visloc.types import LocalFeatures

SCALE_STEP = 2**0.25
MAX_LONG_SIDE_PX = 1024
MIN_LONG_SIDE_PX = 256
MIN_RELIABILITY = 0.7
MIN_REPEATABILITY = 0.7
PATCH_PX = 32  # nominal diameter of what one descriptor describes, at scale 1
# Repeatability is trained to be high in blobs of some pixels, and Fast-R2D2's is interpolated from
# half the resolution: the pixels next to a peak alone say little about where it is.
PEAK_REACH_PX = 2
_MIN_SHORT_SIDE_PX = 8  # below, a network of 51 px receptive field sees mostly padding
# Of the scales at which features could be looked for: first, last, step.
_LEVELS: Mapping[Extraction, tuple[int, int | None, int]] = {
    Extraction.FAST: (1, 2, 1),
    Extraction.DEFAULT: (1, None, 2),
    Extraction.ACCURATE: (0, None, 1),
}
# The thresholds before the functions that lead to them, see _probabilities.
_MIN_RELIABILITY_LOGIT = math.log(MIN_RELIABILITY / (1 - MIN_RELIABILITY))
_MIN_REPEATABILITY_LOGIT = math.log(math.expm1(MIN_REPEATABILITY / (1 - MIN_REPEATABILITY)))


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Output of a network for one image.

    Attributes:
        logits: (2, H, W) float32 of reliability and repeatability, for each pixel.
        descriptors: gives unit rows (N, 128) float32 for pixels x, y (N,) of the logits.
    """

    logits: NDArray[np.float32]
    descriptors: Callable[[NDArray[np.intp], NDArray[np.intp]], NDArray[np.float32]]


class Network(Protocol):
    """A way of computing the network. Safe to call from several threads."""

    @property
    def computed_with(self) -> str:
        """See ``LocalFeatureExtractor``."""

    def look(self, image: NDArray[np.float32]) -> AbstractContextManager[Seen]:
        """Look at RGB (H, W, 3) in 0 to 255; valid within the ``with`` statement only."""


class R2D2Extractor:
    """Multi-scale extraction with R2D2 or Fast-R2D2."""

    descriptor_dim = DESCRIPTOR_DIM

    def __init__(self, name: str, weights_sha256: str, network: Network) -> None:
        self.network = network
        self.fingerprint = Fingerprint(
            name=name,
            revision=2,
            parameters={
                "scale_step": SCALE_STEP,
                "max_long_side_px": MAX_LONG_SIDE_PX,
                "min_long_side_px": MIN_LONG_SIDE_PX,
                "min_reliability": MIN_RELIABILITY,
                "min_repeatability": MIN_REPEATABILITY,
                "peak_reach_px": PEAK_REACH_PX,
            },
            weights_sha256=weights_sha256,
        )

    @property
    def computed_with(self) -> str:
        return self.network.computed_with

    def extract(
        self,
        rgb: NDArray[np.uint8],
        *,
        max_keypoints: int,
        extraction: Extraction = Extraction.ACCURATE,
    ) -> LocalFeatures:
        """Return the strongest keypoints over all scales; see ``LocalFeatureExtractor``.

        Score: reliability times repeatability. The same corner may come from several scales.
        Keypoints are placed below the pixel, descriptors are those of the pixel.
        """
        height, width = rgb.shape[:2]
        found = [_no_features()]
        # In a uniform image the networks respond to the zero padding of its border.
        if (rgb != rgb[0, 0]).any():
            for scale, image in pyramid(rgb, extraction):
                keypoints, descriptors, scores = self._detect(image, max_keypoints)
                size = np.array([width / image.shape[1], height / image.shape[0]], np.float32)
                found.append(
                    LocalFeatures(
                        # the pixel centre is half a pixel of the scaled image from its corner
                        keypoints=(keypoints + np.float32(0.5)) * size,
                        descriptors=descriptors,
                        scores=scores,
                        scales=np.full(len(scores), PATCH_PX / scale, np.float32),
                    )
                )
        return _strongest(found, max_keypoints)

    def _detect(
        self, image: NDArray[np.float32], max_keypoints: int
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Return places (x, y) (N, 2), descriptors and scores of one scale's best.

        A place counts from the centre of the first pixel.
        """
        with self.network.look(image) as seen:
            x, y, scores = _peaks(seen.logits)
            # Row by row, as they lie in memory, which makes sampling faster.
            best = np.sort(np.argsort(-scores, kind="stable")[:max_keypoints])
            x, y = x[best], y[best]
            keypoints = np.stack([x, y], axis=1).astype(np.float32)
            keypoints += peak_offsets(
                seen.logits[1], x, y, reach=PEAK_REACH_PX, log_odds=_log_odds_of_repeatability
            )
            return keypoints, seen.descriptors(x, y), scores[best]


def _peaks(
    logits: NDArray[np.float32],
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float32]]:
    """Return x, y and scores (N,) where repeatability has a peak and both are high enough."""
    reliability, repeatability = logits
    if not logits.size:
        none = np.empty(0, np.intp)
        return none, none, np.empty(0, np.float32)
    # Both functions below rise with the logits: peaks and thresholds are found without them.
    highest = cv2.dilate(repeatability, np.ones((3, 3), np.uint8))
    is_peak = repeatability == highest
    is_peak &= repeatability >= _MIN_REPEATABILITY_LOGIT
    is_peak &= reliability >= _MIN_RELIABILITY_LOGIT
    found = np.flatnonzero(is_peak)
    y, x = np.divmod(found, logits.shape[2])
    softplus = np.logaddexp(np.float32(0), repeatability.ravel()[found])
    scores = softplus / (1 + softplus) / (1 + np.exp(-reliability.ravel()[found]))
    return x, y, scores


def _log_odds_of_repeatability(logits: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return log(p / (1 - p)) of p = softplus / (1 + softplus): the logarithm of softplus."""
    logits = np.maximum(logits, np.float32(-80))  # the softplus of less would be zero
    softplus = np.maximum(logits, 0) + np.log1p(np.exp(-np.abs(logits)))
    return np.asarray(np.log(softplus))


def pyramid_sizes(height: int, width: int) -> Iterator[tuple[float, tuple[int, int], bool]]:
    """Yield (scale, (height, width), whether to look for features), largest first.

    Scales are powers of 2^(-1/4). Features are looked for where the long side is within
    256 to 1024 px, in an image below that at its own size.
    """
    long_side = max(height, width)
    smallest = min(MIN_LONG_SIDE_PX / long_side, 1.0)
    scale = 1.0
    while scale + 0.001 >= smallest:
        size = (round(height * scale), round(width * scale))
        yield scale, size, scale - 0.001 <= MAX_LONG_SIDE_PX / long_side
        scale /= SCALE_STEP


def _levels_to_use(rgb_shape: tuple[int, ...], extraction: Extraction) -> set[float]:
    """Return the scales at which to look for features: those of the effort that there are."""
    scales = [
        scale
        for scale, size, is_used in pyramid_sizes(*rgb_shape[:2])
        if is_used and min(size) >= _MIN_SHORT_SIDE_PX
    ]
    first, last, step = _LEVELS[extraction]
    return set(scales[first:last:step] or scales[-1:])


def pyramid(
    rgb: NDArray[np.uint8], extraction: Extraction
) -> Iterator[tuple[float, NDArray[np.float32]]]:
    """Yield (scale, image (h, w, 3) in 0 to 255); each is made from the one before.

    That smooths more than one resampling of the photo would, and the networks' published
    figures depend on it.
    """
    image = rgb.astype(np.float32)
    remaining = _levels_to_use(rgb.shape, extraction)
    for scale, size, _ in pyramid_sizes(*rgb.shape[:2]):
        if not remaining:
            return
        if image.shape[:2] != size:
            smaller = cv2.resize(image, size[::-1], interpolation=cv2.INTER_LINEAR)
            image = np.asarray(smaller, np.float32)
        if scale in remaining:
            remaining.remove(scale)
            yield scale, image


def _no_features() -> LocalFeatures:
    return LocalFeatures(
        keypoints=np.empty((0, 2), np.float32),
        descriptors=np.empty((0, DESCRIPTOR_DIM), np.float32),
        scores=np.empty(0, np.float32),
        scales=np.empty(0, np.float32),
    )


def _strongest(found: list[LocalFeatures], max_keypoints: int) -> LocalFeatures:
    scores = np.concatenate([features.scores for features in found])
    best = np.argsort(-scores, kind="stable")[:max_keypoints]
    return LocalFeatures(
        keypoints=np.concatenate([features.keypoints for features in found])[best],
        descriptors=np.concatenate([features.descriptors for features in found])[best],
        scores=scores[best],
        scales=np.concatenate([features.scales for features in found])[best],
    )
