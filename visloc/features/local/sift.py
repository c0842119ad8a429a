"""SIFT (Lowe 2004) by OpenCV, with RootSIFT descriptors (Arandjelovic and Zisserman 2012)."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from visloc.features.base import Fingerprint, LocalFeatureExtractor
from visloc.options import Extraction, Inference
from visloc.types import LocalFeatures

DESCRIPTOR_DIM = 128
MAX_LONG_SIDE_PX = 1600
OCTAVE_LAYERS = 3
CONTRAST_THRESHOLD = 0.04
EDGE_THRESHOLD = 10.0
SIGMA = 1.6
# 4 x 4 histograms, each 3 sigma wide; OpenCV's keypoint size is 2 sigma.
_PATCH_PER_SIZE = 4 * 3 / 2


def load_sift(
    _weights_dir: Path | None = None,
    _inference: Inference = Inference.AUTO,
    _threads: int | None = None,
) -> LocalFeatureExtractor:
    """Make the SIFT extractor, which needs no weights."""
    return SiftExtractor()


class SiftExtractor:
    """SIFT keypoints; one with several orientations counts as several features."""

    fingerprint = Fingerprint(
        name="sift",
        revision=1,
        parameters={
            "max_long_side_px": MAX_LONG_SIDE_PX,
            "octave_layers": OCTAVE_LAYERS,
            "contrast_threshold": CONTRAST_THRESHOLD,
            "edge_threshold": EDGE_THRESHOLD,
            "sigma": SIGMA,
        },
    )

    descriptor_dim = DESCRIPTOR_DIM
    computed_with = f"OpenCV {cv2.__version__}"

    def extract(
        self,
        rgb: NDArray[np.uint8],
        *,
        max_keypoints: int,
        extraction: Extraction = Extraction.ACCURATE,  # noqa: ARG002 - one way only
    ) -> LocalFeatures:
        """Return the keypoints of the strongest response; see ``LocalFeatureExtractor``."""
        grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
        height, width = grey.shape
        shrink = MAX_LONG_SIDE_PX / max(height, width)
        if shrink < 1:
            size = (max(round(width * shrink), 1), max(round(height * shrink), 1))
            grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        # Made per call, because OpenCV does not say that its objects may be shared by threads.
        sift = cv2.SIFT.create(
            nfeatures=max_keypoints,
            nOctaveLayers=OCTAVE_LAYERS,
            contrastThreshold=CONTRAST_THRESHOLD,
            edgeThreshold=EDGE_THRESHOLD,
            sigma=SIGMA,
            enable_precise_upscale=True,  # without it, keypoints are 0.23 px off
        )
        found, raw_descriptors = sift.detectAndCompute(grey, None)
        scores = np.array([point.response for point in found], np.float32)
        best = np.argsort(-scores, kind="stable")[:max_keypoints]
        if not len(best):  # then OpenCV gives no array of descriptors
            raw_descriptors = np.empty((0, DESCRIPTOR_DIM), np.float32)
        # OpenCV counts pixel centres from 0.
        centers = np.array([point.pt for point in found], np.float32).reshape(-1, 2) + 0.5
        size_ratio = np.array([width / grey.shape[1], height / grey.shape[0]], np.float32)
        sizes = np.array([point.size for point in found], np.float32)
        return LocalFeatures(
            keypoints=(centers * size_ratio)[best],
            descriptors=_root_sift(raw_descriptors[best].astype(np.float32, copy=False)),
            scores=scores[best],
            scales=(sizes * _PATCH_PER_SIZE * size_ratio.max())[best],
        )


def _root_sift(descriptors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Square roots of the rows' L1-normalized entries: Euclidean distance becomes Hellinger's."""
    total = descriptors.sum(axis=1, keepdims=True)
    rooted: NDArray[np.float32] = np.sqrt(descriptors / np.maximum(total, 1e-12))
    return rooted
