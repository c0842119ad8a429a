"""XFeat with OpenVINO, in floats or with most convolutions in 8 bits."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from visloc.features.backends.calibration import measure, ranges_of
from visloc.features.backends.openvino import (
    Graph,
    GraphBuilder,
    Ranges,
    import_openvino,
    openvino_with,
)
from visloc.features.networks.xfeat.extractor import Seen, network_input
from visloc.features.networks.xfeat.model import CELL_PX, LAYERS, XFeatNetwork

_VARIANCE_EPSILON = 1e-5


# In 8 bits the first block and the keypoint head, which see the image itself, would move every
# fifth keypoint.
_QUANTIZED_BLOCKS = ("block2", "block3", "block4", "block5", "block_fusion", "heatmap_head")


def make_openvino_network(
    network: XFeatNetwork, weights_sha256: str, *, in_8_bits: bool, threads: int | None
) -> OpenVinoNetwork:
    """Compile the network; see ``ranges_of`` for the first time in 8 bits."""
    if not in_8_bits:
        return OpenVinoNetwork(network, None, threads)
    ranges = ranges_of(
        "xfeat", weights_sha256, _quantized(), lambda: measure_ranges(network, threads)
    )
    return OpenVinoNetwork(network, ranges, threads)


def measure_ranges(network: XFeatNetwork, threads: int | None = None) -> Ranges:
    """Measure the ranges that ``OpenVinoNetwork`` takes."""
    names = _quantized()
    grey, builder, _ = _network(network, None)
    graph = Graph([grey], builder.extremes(names), threads)
    return measure(names, graph, lambda rgb: _input(network_input(rgb)))


def _quantized() -> list[str]:
    return [layer.name for layer in LAYERS if layer.block in _QUANTIZED_BLOCKS]


class OpenVinoNetwork:
    """Computes the network with OpenVINO; in 8 bits if there are ranges."""

    def __init__(self, network: XFeatNetwork, ranges: Ranges | None, threads: int | None) -> None:
        grey, _, outputs = _network(network, ranges)
        self._graph = Graph([grey], outputs, threads)
        self.computed_with = openvino_with(ranges)

    def look(self, grey: NDArray[np.float32]) -> Seen:
        """Look at a grey image (H, W) whose sides are multiples of 32."""
        heat, reliability, features = self._graph(_input(grey))
        return Seen(heat[0, 0], reliability[0, 0], features[0])


def _input(grey: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.ascontiguousarray(grey)[None, None]


def _network(network: XFeatNetwork, ranges: Ranges | None) -> tuple[Any, GraphBuilder, list[Any]]:
    """Return the input (1, 1, H, W), the builder, and what ``Seen`` holds."""
    _, operations = import_openvino()
    builder = GraphBuilder(ranges)

    def block(name: str, x: Any) -> Any:
        for layer, convolution in network.block(name):
            x = builder.convolution(x, layer.name, convolution, relu=layer.normalized)
        return x

    def enlarged(x: Any, times: float) -> Any:
        return operations.interpolate(
            x,
            builder.constant([times, times]),
            "linear_onnx",
            "scales",
            coordinate_transformation_mode="half_pixel",
            axes=np.array([2, 3]),
        )

    grey = operations.parameter([1, 1, -1, -1], np.float32, name="grey")
    image = operations.mvn(grey, np.array([2, 3]), True, _VARIANCE_EPSILON, "inside_sqrt")
    quarter = operations.avg_pool(
        image, [4, 4], [0, 0], [0, 0], [4, 4], exclude_pad=True, rounding_type="floor"
    )
    skip = block("skip1", quarter)
    eighth = block("block3", block("block2", operations.add(block("block1", image), skip)))
    sixteenth = block("block4", eighth)
    thirty_second = block("block5", sixteenth)
    fused = operations.add(
        operations.add(eighth, enlarged(sixteenth, 2)), enlarged(thirty_second, 4)
    )
    features = block("block_fusion", fused)
    reliability = operations.sigmoid(block("heatmap_head", features))
    cells = operations.space_to_depth(image, "depth_first", CELL_PX)
    probabilities = operations.softmax(block("keypoint_head", cells), 1)
    heat = operations.depth_to_space(
        operations.slice(
            probabilities, np.array([0]), np.array([-1]), np.array([1]), np.array([1])
        ),
        "depth_first",
        CELL_PX,
    )
    unit = operations.normalize_l2(features, np.array([1]), 1e-24, "max")
    return grey, builder, [heat, reliability, operations.transpose(unit, np.array([0, 2, 3, 1]))]
