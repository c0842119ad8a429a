"""R2D2 and Fast-R2D2 with OpenVINO, in floats or with 8-bit convolutions."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
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
from visloc.features.networks.interpolated import squared_heads, squared_heads_at_double_resolution
from visloc.features.networks.r2d2.extractor import Seen
from visloc.features.networks.r2d2.model import MEAN, STD, R2D2Network


def make_openvino_network(
    network: R2D2Network, weights_sha256: str, *, in_8_bits: bool, threads: int | None
) -> OpenVinoNetwork:
    """Compile the network; see ``ranges_of`` for the first time in 8 bits."""
    if not in_8_bits:
        return OpenVinoNetwork(network, None, threads)
    name, names = network.architecture.name, _names(network)[1:]
    ranges = ranges_of(name, weights_sha256, names, lambda: measure_ranges(network, threads))
    return OpenVinoNetwork(network, ranges, threads)


def measure_ranges(network: R2D2Network, threads: int | None = None) -> Ranges:
    """Measure the ranges that ``OpenVinoNetwork`` takes."""
    # The first convolution stays in floats: a hundredth of the work, and most of the error.
    names = _names(network)[1:]
    image, builder, _ = _trunk(network, None)
    return measure(names, Graph([image], builder.extremes(names), threads), _input)


def _names(network: R2D2Network) -> list[str]:
    return [f"convolutions.{number}" for number, _ in enumerate(network.convolutions)]


class OpenVinoNetwork:
    """Computes the network with OpenVINO; in 8 bits if there are ranges."""

    def __init__(self, network: R2D2Network, ranges: Ranges | None, threads: int | None) -> None:
        image, _, features = _trunk(network, ranges)
        self._graph = Graph([image], [features], threads)
        self._stride = network.architecture.stride
        self._heads = network.heads.weight[:, :, 0, 0], network.heads.bias
        self.computed_with = openvino_with(ranges)

    @contextmanager
    def look(self, image: NDArray[np.float32]) -> Iterator[Seen]:
        """Look at RGB (H, W, 3) in 0 to 255."""
        heads = squared_heads if self._stride == 1 else squared_heads_at_double_resolution
        # 39 MB at 640 x 480: copying them takes 2 to 4 % of the time.
        with self._graph.computed(_input(image)) as (batch,):
            features = batch[0]

            def descriptors(x: NDArray[np.intp], y: NDArray[np.intp]) -> NDArray[np.float32]:
                sampled = _sampled(features, x, y, self._stride)
                norms = np.maximum(np.linalg.norm(sampled, axis=1, keepdims=True), 1e-12)
                unit: NDArray[np.float32] = sampled / norms
                return unit

            yield Seen(heads(features, *self._heads), descriptors)


def _input(image: NDArray[Any]) -> NDArray[np.float32]:
    return np.ascontiguousarray(image[None], np.float32)


def _trunk(network: R2D2Network, ranges: Ranges | None) -> tuple[Any, GraphBuilder, Any]:
    """Return the input (1, H, W, 3) in 0 to 255, the builder, and x (1, 128, h, w)."""
    _, operations = import_openvino()
    builder = GraphBuilder(ranges)
    image = operations.parameter([1, -1, -1, 3], np.float32, name="image")
    x = operations.transpose(image, np.array([0, 3, 1, 2]))
    mean, deviation = (np.array(values)[None, :, None, None] for values in (MEAN, STD))
    x = operations.subtract(x, builder.constant(mean))
    x = operations.multiply(x, builder.constant(1 / deviation))
    architecture, names = network.architecture, _names(network)
    for number, convolution in enumerate(network.convolutions):
        relu = architecture.layers[number].relu
        x = builder.convolution(x, names[number], convolution, relu=relu)
        if number + 1 == architecture.pool_after:
            x = builder.max_pool(builder.quantized(x, names[number + 1]))
    return image, builder, x


def _sampled(
    features: NDArray[np.float32], x: NDArray[np.intp], y: NDArray[np.intp], stride: int
) -> NDArray[np.float32]:
    """Return x (N, 128) of the network at pixels (x, y) of the full resolution."""
    channels, height, width = features.shape
    flat = features.reshape(channels, height * width)
    if stride == 1:
        return flat[:, y * width + x].T
    left, right, from_left = _neighbours(x, stride, width)
    above, below, from_above = _neighbours(y, stride, height)
    sampled = np.zeros((channels, len(x)), np.float32)
    for row, row_weight in ((above, 1 - from_above), (below, from_above)):
        for column, column_weight in ((left, 1 - from_left), (right, from_left)):
            neighbour = flat[:, row * width + column]
            neighbour *= row_weight * column_weight
            sampled += neighbour
    return sampled.T


def _neighbours(
    index: NDArray[np.intp], stride: int, size: int
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float32]]:
    """Return both neighbours at low resolution and the second one's weight, each (N,)."""
    position = np.clip((index + 0.5) / stride - 0.5, 0, size - 1)
    lower = position.astype(np.intp)
    return lower, np.minimum(lower + 1, size - 1), (position - lower).astype(np.float32)
