"""Chooses how EfficientNet-Lite0 is computed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from visloc.features.backends.choice import choose_inference
from visloc.features.networks.efficientnet.model import Block
from visloc.options import Inference


class Network(Protocol):
    """A way of computing the network. Safe to call from several threads."""

    @property
    def computed_with(self) -> str:
        """See ``LocalFeatureExtractor``."""

    def look(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return what the last block makes of what ``network_input`` gives.

        Of all blocks: features (1280, H / 32, W / 32), 0 to 6.
        """


def make_network(blocks: Sequence[Block], inference: Inference, threads: int | None) -> Network:
    """Make the way of computing these first blocks; INT8 is computed in floats as well.

    Raises:
        InvalidInput: ``inference.unavailable``.
    """
    if choose_inference(inference) is Inference.TORCH:
        from visloc.features.networks.efficientnet.torch import TorchNetwork

        return TorchNetwork(blocks)
    from visloc.features.networks.efficientnet.openvino import OpenVinoNetwork

    return OpenVinoNetwork(blocks, threads)
