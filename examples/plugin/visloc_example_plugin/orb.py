"""ORB keypoints (Rublee et al., ICCV 2011) by OpenCV."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from visloc.features import Fingerprint, LocalFeatureExtractor
from visloc.options import Extraction, Inference
from visloc.types import LocalFeatures

_BITS = 256
_PATCH_PX = 31  # in the layer of OpenCV's pyramid that a keypoint was found in


def load_orb(
    _weights_dir: Path | None, _inference: Inference, _threads: int | None
) -> LocalFeatureExtractor:
    """Make the extractor; a network would read its weights here."""
    return Orb()


class Orb:
    """A ``LocalFeatureExtractor``."""

    # Raise the revision whenever other features come out.
    fingerprint = Fingerprint("example-orb", revision=1, parameters={})
    computed_with = f"opencv {cv2.__version__}"
    descriptor_dim = _BITS

    def extract(
        self,
        rgb: NDArray[np.uint8],
        *,
        max_keypoints: int,
        extraction: Extraction = Extraction.ACCURATE,  # noqa: ARG002 - one way only
    ) -> LocalFeatures:
        """Return the strongest keypoints."""
        found: Sequence[cv2.KeyPoint] = ()
        bits = None
        if min(rgb.shape[:2]) > 2 * _PATCH_PX:  # OpenCV fails where no patch is within the photo
            orb = cv2.ORB.create(nfeatures=max_keypoints)  # each call its own: threads share self
            found, bits = orb.detectAndCompute(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), None)
        scores = np.array([keypoint.response for keypoint in found], np.float32)
        best = np.argsort(-scores, kind="stable")[:max_keypoints]
        packed = np.zeros((0, _BITS // 8), np.uint8) if bits is None else np.asarray(bits, np.uint8)
        # A bit becomes plus or minus one, so that the cosine of two rows tells how many bits agree.
        signs = np.unpackbits(packed[best], axis=1).astype(np.float32) * 2 - 1
        places = np.array([found[i].pt for i in best], np.float32).reshape(-1, 2)
        sizes = np.array([found[i].size for i in best], np.float32)
        return LocalFeatures(
            # OpenCV counts pixels from the centre of the first, which is half a pixel of its layer
            # from the corner, where visloc counts from.
            keypoints=places + sizes[:, None] / np.float32(2 * _PATCH_PX),
            descriptors=signs / np.float32(np.sqrt(_BITS)),
            scores=scores[best],
            scales=sizes,
        )
