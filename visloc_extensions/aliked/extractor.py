"""Finds keypoints with ALIKED at one scale of a photo."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from visloc.features.base import Fingerprint
from visloc.options import Extraction
from visloc.types import LocalFeatures
from visloc_extensions.aliked.model import Architecture, Padding

MAX_LONG_SIDE_PX = 1280
MIN_SCORE = 0.2  # of the paper, as are the radius and the temperature
RADIUS_PX = 2  # of the neighbourhood in which a keypoint is the strongest, and is refined
_TEMPERATURE = 0.1
SIZE_MULTIPLE_PX = 32  # the coarsest layers have a 32nd of the resolution
CELL_PX = 8  # one cell of the features of the third block


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Output of the network for one image.

    Attributes:
        scores: (H, W) float32 in 0 to 1.
        describe: gives descriptors (N, D) float32, rows of unit length, of places (N, 2) in
            pixels that count the centre of the top-left one as (0, 0).
    """

    scores: NDArray[np.float32]
    describe: Callable[[NDArray[np.float32]], NDArray[np.float32]]


class Network(Protocol):
    """A way of computing the network. Safe to call from several threads."""

    @property
    def computed_with(self) -> str:
        """See ``LocalFeatureExtractor``."""

    def look(self, rgb: NDArray[np.uint8]) -> Seen:
        """Look at an image (H, W, 3) of any size."""


class AlikedExtractor:
    """Sparse ALIKED keypoints at one scale."""

    def __init__(self, architecture: Architecture, weights_sha256: str, network: Network) -> None:
        self.network = network
        self.descriptor_dim = architecture.descriptor_dim
        self.fingerprint = Fingerprint(
            name=architecture.name,
            revision=1,
            parameters={
                "max_long_side_px": MAX_LONG_SIDE_PX,
                "min_score": MIN_SCORE,
                "nms_px": 2 * RADIUS_PX + 1,
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
        extraction: Extraction = Extraction.ACCURATE,  # noqa: ARG002 - one way only
    ) -> LocalFeatures:
        """Return the strongest keypoints; see ``LocalFeatureExtractor``.

        Score: the network's, at the pixel of the keypoint.
        """
        image = network_input(rgb)
        seen = self.network.look(image)
        rows, columns = np.nonzero(peaks(seen.scores) & (seen.scores > MIN_SCORE))
        scores = seen.scores[rows, columns]
        best = np.argsort(-scores, kind="stable")[:max_keypoints]
        places = refined(seen.scores, rows[best], columns[best])
        size_ratio = np.array(
            [rgb.shape[1] / image.shape[1], rgb.shape[0] / image.shape[0]], np.float32
        )
        return LocalFeatures(
            keypoints=(places + np.float32(0.5)) * size_ratio,
            descriptors=seen.describe(places),
            scores=scores[best],
            scales=np.full(len(best), CELL_PX * size_ratio.max(), np.float32),
        )


def network_input(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the image, shrunk if its longer side exceeds 1280."""
    shrink = MAX_LONG_SIDE_PX / max(rgb.shape[:2])
    if shrink >= 1:
        return rgb
    height, width = (max(round(side * shrink), 1) for side in rgb.shape[:2])
    # Averages as far as it must; OpenCV's ways either alias or, for odd ratios, leave steps.
    return np.asarray(Image.fromarray(rgb).resize((width, height), Image.Resampling.BILINEAR))


def padding_of(height: int, width: int) -> Padding:
    """Return the padding of an image, half of it on either side as the network's authors do.

    Unlike stretching it to the next multiple, this leaves the photo's pixels as they are; the
    coarse layers are laid over the padded image either way.
    """
    rows, columns = -height % SIZE_MULTIPLE_PX, -width % SIZE_MULTIPLE_PX
    return Padding(rows // 2, rows - rows // 2, columns // 2, columns - columns // 2)


def padded(rgb: NDArray[np.uint8], padding: Padding) -> NDArray[np.uint8]:
    """Return the image with its outermost pixels repeated."""
    sides = (padding.top, padding.bottom, padding.left, padding.right)
    return np.asarray(cv2.copyMakeBorder(rgb, *sides, cv2.BORDER_REPLICATE), np.uint8)


def peaks(scores: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return which pixels (H, W) are the strongest within ``RADIUS_PX`` rows and columns.

    Those that are so once the neighbourhoods of stronger peaks are left out count as well, twice.
    None is nearer than that to the border, where its neighbourhood is not whole.
    """
    window = np.ones((2 * RADIUS_PX + 1,) * 2, np.uint8)
    found = scores == cv2.dilate(scores, window)
    for _ in range(2):
        taken = cv2.dilate(found.astype(np.uint8), window) > 0
        left = np.where(taken, np.float32(0), scores)
        found |= (left == cv2.dilate(left, window)) & ~taken
    inside = np.zeros_like(found)
    inside[RADIUS_PX:-RADIUS_PX, RADIUS_PX:-RADIUS_PX] = True
    found &= inside
    return np.asarray(found, np.bool_)


def refined(
    scores: NDArray[np.float32], rows: NDArray[np.intp], columns: NDArray[np.intp]
) -> NDArray[np.float32]:
    """Return places (N, 2), (x, y), of peaks below the pixel; the top-left centre is (0, 0).

    They are the means of the pixels around, weighted by exp(score / 0.1) (paper, eq. 8).
    """
    steps = np.arange(-RADIUS_PX, RADIUS_PX + 1)
    patches = scores[rows[:, None, None] + steps[:, None], columns[:, None, None] + steps]
    weights = np.exp((patches - scores[rows, columns][:, None, None]) / np.float32(_TEMPERATURE))
    weights /= weights.sum(axis=(1, 2), keepdims=True)
    x = columns + weights.sum(axis=1) @ steps.astype(np.float32)
    y = rows + weights.sum(axis=2) @ steps.astype(np.float32)
    return np.stack([x, y], axis=1).astype(np.float32)
