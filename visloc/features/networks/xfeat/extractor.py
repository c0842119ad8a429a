"""Finds keypoints with XFeat at one scale of a photo."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.sparse import csr_array

from visloc.features.base import Fingerprint
from visloc.features.local.subpixel import peak_offsets
from visloc.options import Extraction
from visloc.types import LocalFeatures

DESCRIPTOR_DIM = 64
CELL_PX = 8  # one cell of the feature map
MAX_LONG_SIDE_PX = 1280
MIN_HEAT = 0.05
_SIZE_MULTIPLE_PX = 32  # the coarsest layers have a 32nd of the resolution
_NMS_PX = 5
PEAK_REACH_PX = 1  # each cell has one peak, which is narrow


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Output of the network for one image.

    Attributes:
        heat: (H, W) float32, probability that the keypoint of a cell is at this pixel.
        reliability: (H / 8, W / 8) float32 in 0 to 1.
        features: (H / 8, W / 8, 64) float32, rows of unit length.
    """

    heat: NDArray[np.float32]
    reliability: NDArray[np.float32]
    features: NDArray[np.float32]


class Network(Protocol):
    """A way of computing the network. Safe to call from several threads."""

    @property
    def computed_with(self) -> str:
        """See ``LocalFeatureExtractor``."""

    def look(self, grey: NDArray[np.float32]) -> Seen:
        """Look at a grey image (H, W) whose sides are multiples of 32."""


class XFeatExtractor:
    """Sparse XFeat keypoints at one scale."""

    descriptor_dim = DESCRIPTOR_DIM

    def __init__(self, weights_sha256: str, network: Network) -> None:
        self.network = network
        self.fingerprint = Fingerprint(
            name="xfeat",
            revision=2,
            parameters={
                "max_long_side_px": MAX_LONG_SIDE_PX,
                "min_heat": MIN_HEAT,
                "nms_px": _NMS_PX,
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
        extraction: Extraction = Extraction.ACCURATE,  # noqa: ARG002 - one way only
    ) -> LocalFeatures:
        """Return the strongest keypoints; see ``LocalFeatureExtractor``.

        Score: probability of the keypoint within its cell times reliability. Keypoints are
        placed below the pixel, descriptors are those of the pixel.
        """
        grey = network_input(rgb)
        seen = self.network.look(grey)
        highest = cv2.dilate(seen.heat, np.ones((_NMS_PX, _NMS_PX), np.uint8))
        found = np.flatnonzero((seen.heat == highest) & (seen.heat > MIN_HEAT))
        y, x = np.divmod(found, grey.shape[1])
        centers = np.stack([x, y], axis=1).astype(np.float32) + np.float32(0.5)
        reliability = _sampled(seen.reliability[:, :, None], centers, _BILINEAR)[:, 0]
        scores = seen.heat.ravel()[found] * reliability
        best = np.argsort(-scores, kind="stable")[:max_keypoints]
        x, y, centers = x[best], y[best], centers[best]
        descriptors = _sampled(seen.features, centers, _BICUBIC)
        offsets = peak_offsets(seen.heat, x, y, reach=PEAK_REACH_PX, log_odds=_log_odds)
        descriptors /= np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-12)
        size_ratio = np.array(
            [rgb.shape[1] / grey.shape[1], rgb.shape[0] / grey.shape[0]], np.float32
        )
        return LocalFeatures(
            keypoints=(centers + offsets) * size_ratio,
            descriptors=descriptors,
            scores=scores[best],
            scales=np.full(len(best), CELL_PX * size_ratio.max(), np.float32),
        )


def _log_odds(heat: NDArray[np.float32]) -> NDArray[np.float32]:
    # Where the odds are nothing or everything in single precision.
    heat = np.clip(heat, np.float32(1e-30), np.float32(1 - 1e-7))
    return np.asarray(np.log(heat / (1 - heat)))


def network_input(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the grey image (H, W) in 0..1, its sides multiples of 32 and at most 1280.

    It is stretched to the nearest multiple rather than cropped or padded, so that nothing of
    the photo is lost and no edge is made.
    """
    mean = np.full((1, 3), 1 / (3 * 255))
    grey = np.asarray(cv2.transform(rgb.astype(np.float32), mean), np.float32)
    shrink = min(MAX_LONG_SIDE_PX / max(rgb.shape[:2]), 1.0)
    height, width = (
        max(round(side * shrink / _SIZE_MULTIPLE_PX), 1) * _SIZE_MULTIPLE_PX
        for side in rgb.shape[:2]
    )
    if grey.shape[:2] == (height, width):
        return grey
    # OpenCV's ways either alias or, stretching, leave steps; this one averages as far as it must.
    return np.asarray(Image.fromarray(grey).resize((width, height), Image.Resampling.BILINEAR))


def _sampled(
    cells: NDArray[np.float32], centers: NDArray[np.float32], kernel: Kernel
) -> NDArray[np.float32]:
    """Return (N, C) values of a map by cells (h, w, C) at points (N, 2) in pixels."""
    height, width, channels = cells.shape
    places = centers / np.float32(CELL_PX) - np.float32(0.5)
    columns, column_weights = _taps(places[:, 0], width, kernel)
    rows, row_weights = _taps(places[:, 1], height, kernel)
    index = rows[:, :, None] * width + columns[:, None, :]
    weights = row_weights[:, :, None] * column_weights[:, None, :]
    taps = weights[0].size if len(centers) else 1
    starts = np.arange(0, taps * (len(centers) + 1), taps)
    interpolation = csr_array(
        (weights.ravel(), index.ravel(), starts), shape=(len(centers), height * width)
    )
    sampled: NDArray[np.float32] = interpolation @ cells.reshape(height * width, channels)
    return sampled


def _taps(
    places: NDArray[np.float32], size: int, kernel: Kernel
) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Return the cells around each place along one axis, and their weights, each (N, 2 or 4)."""
    reach, weight = kernel
    offsets = np.arange(1 - reach, reach + 1)
    lower = np.floor(places)
    distances = np.abs((places - lower)[:, None] - offsets.astype(np.float32))
    return np.clip(lower.astype(np.intp)[:, None] + offsets, 0, size - 1), weight(distances)


def _linear(distance: NDArray[np.float32]) -> NDArray[np.float32]:
    return 1 - distance


def _cubic(distance: NDArray[np.float32]) -> NDArray[np.float32]:
    """Weigh by cubic convolution (Keys 1981) with a = -0.75."""
    a = np.float32(-0.75)
    near = ((a + 2) * distance - (a + 3)) * distance**2 + 1
    far = a * (((distance - 5) * distance + 8) * distance - 4)
    return np.where(distance <= 1, near, far)


# Cells on either side that a kernel reaches, and their weights by distance.
Kernel = tuple[int, Callable[[NDArray[np.float32]], NDArray[np.float32]]]
_BILINEAR: Kernel = (1, _linear)
_BICUBIC: Kernel = (2, _cubic)
