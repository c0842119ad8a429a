"""VLAD of a network's features, one word for each cell of 16 x 16 pixels.

What NetVLAD does (Arandjelovic et al., CVPR 2016) without any training on places: the network is
EfficientNet-Lite0 as trained to tell objects apart, cut where its cells still are small, and the
vocabulary is learned on the map.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from visloc.features.base import Fingerprint, GlobalDescriptor
from visloc.features.descriptors.vlad import VLAD_PARAMETERS, VladDescriptor
from visloc.features.descriptors.whitening import unit_rows
from visloc.options import Inference
from visloc.types import LocalFeatures
from visloc_extensions.descriptors.efficientnet.load import (
    MAX_LONG_SIDE_PX,
    Network,
    make_network,
    network_input,
)

# After the stem, all blocks before the last halving of the resolution: 112 channels.
NUM_BLOCKS = 11


def load_convvlad(
    weights_dir: Path | None = None,
    inference: Inference = Inference.AUTO,
    threads: int | None = None,
) -> GlobalDescriptor:
    """Make the descriptor from the weights in the folder, or in the installed package.

    INT8 is computed in floats, as for ``gem``.
    """
    return ConvVlad(*make_network("convvlad", NUM_BLOCKS, weights_dir, inference, threads))


class ConvVlad(VladDescriptor):
    """A photo's words are the channels (112) of the network's cells."""

    needs_image = True  # words lie on a grid, not at keypoints
    needs_local_features = False

    def __init__(self, network: Network, weights_sha256: str) -> None:
        self._network = network
        self.fingerprint = Fingerprint(
            "convvlad",
            revision=1,
            parameters={"max_long_side_px": MAX_LONG_SIDE_PX, **VLAD_PARAMETERS},
            weights_sha256=weights_sha256,
        )
        self.computed_with = network.computed_with

    def words(
        self,
        rgb: NDArray[np.uint8],
        local: LocalFeatures,  # noqa: ARG002 - words are taken everywhere, not at keypoints
    ) -> NDArray[np.float32]:
        """Return one row (112,) of unit length for each cell."""
        features = self._network.look(network_input(rgb))
        return unit_rows(np.ascontiguousarray(features.reshape(len(features), -1).T))
