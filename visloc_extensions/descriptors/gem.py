"""Generalized-mean pooling of a network trained to tell objects apart.

Pooling and its exponent: Radenovic et al., "Fine-tuning CNN image retrieval with no human
annotation" (TPAMI 2018, arXiv:1711.02512). The network here, EfficientNet-Lite0, is small, free
for any use, and was never trained on places; its whitening is learned on the map.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from visloc.features.base import Fingerprint, GlobalDescriptor
from visloc.features.descriptors.image_descriptor import ImageDescriptor
from visloc.features.descriptors.whitening import WHITENING_PARAMETERS
from visloc.options import Inference
from visloc_extensions.descriptors.efficientnet.load import (
    MAX_LONG_SIDE_PX,
    Network,
    make_network,
    network_input,
)
from visloc_extensions.descriptors.pooling import generalized_mean

EXPONENT = 3.0  # with which the paper's networks start, and end near


def load_gem(
    weights_dir: Path | None = None,
    inference: Inference = Inference.AUTO,
    threads: int | None = None,
) -> GlobalDescriptor:
    """Make the descriptor from the weights in the folder, or in the installed package.

    INT8 is computed in floats: the whole network takes little time.
    """
    return Gem(*make_network("gem", None, weights_dir, inference, threads))


class Gem(ImageDescriptor):
    """A photo's raw vector is the generalized mean (1280,) of the last convolution's output.

    That is the layer whose mean the classifier was trained to read; unlike the one before, its
    values are not negative, as the generalized mean needs them.
    """

    def __init__(self, network: Network, weights_sha256: str) -> None:
        self._network = network
        self.computed_with = network.computed_with
        self.fingerprint = Fingerprint(
            "gem",
            revision=1,
            parameters={
                "exponent": EXPONENT,
                "max_long_side_px": MAX_LONG_SIDE_PX,
                **WHITENING_PARAMETERS,
            },
            weights_sha256=weights_sha256,
        )

    def look(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the raw vector (1280,), of unit length, of a photo (H, W, 3)."""
        pooled = generalized_mean(self._network.look(network_input(rgb)), EXPONENT)
        unit: NDArray[np.float32] = pooled / np.linalg.norm(pooled)
        return unit
