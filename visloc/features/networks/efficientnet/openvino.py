"""EfficientNet-Lite0 with OpenVINO, in floats."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from visloc.features.backends.openvino import Graph, GraphBuilder, import_openvino, openvino_with
from visloc.features.networks.efficientnet.model import Block


class OpenVinoNetwork:
    """Computes the network with OpenVINO."""

    def __init__(self, blocks: Sequence[Block], threads: int | None) -> None:
        _, operations = import_openvino()
        builder = GraphBuilder()
        image = x = operations.parameter([1, 3, -1, -1], np.float32, name="image")
        for number, block in enumerate(blocks):
            entered = x
            for step, (convolution, relu6) in enumerate(block.convolutions):
                x = builder.convolution(x, f"{number}.{step}", convolution)
                if relu6:
                    x = operations.clamp(x, 0.0, 6.0)
            if block.adds_input:
                x = operations.add(entered, x)
        self._graph = Graph([image], [x], threads)
        self.computed_with = openvino_with(None)

    def look(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return what the last block makes of what ``network_input`` gives."""
        (features,) = self._graph(pixels)
        found: NDArray[np.float32] = features[0]
        return found
