"""Makes the local features R2D2 and Fast-R2D2."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from visloc.features.backends.graphs import open_graph
from visloc.features.backends.openvino import Graph
from visloc.features.base import LocalFeatureExtractor
from visloc.features.networks.interpolated import squared_heads, squared_heads_at_double_resolution
from visloc.features.networks.r2d2.architecture import FAST_R2D2, R2D2, Architecture
from visloc.features.networks.r2d2.extractor import R2D2Extractor, Seen
from visloc.features.weights.checkpoint import sha256_of
from visloc.features.weights.files import SHIPPED, own_path, published_path, shipped_path
from visloc.options import Inference


def load_r2d2(
    weights_dir: Path | None,
    inference: Inference = Inference.AUTO,
    threads: int | None = None,
) -> LocalFeatureExtractor:
    """Make R2D2 from ``r2d2_WASF_N16.pt`` or ``r2d2.safetensors`` in the weights folder."""
    return _load(R2D2, weights_dir, inference, threads)


def load_faster2d2(
    weights_dir: Path | None,
    inference: Inference = Inference.AUTO,
    threads: int | None = None,
) -> LocalFeatureExtractor:
    """Make Fast-R2D2 from ``faster2d2_WASF_N16.pt`` or ``faster2d2.safetensors`` in the folder.

    Without either, from our own weights, which are part of this software.
    """
    return _load(FAST_R2D2, weights_dir, inference, threads)


def weights_path(architecture: Architecture, weights_dir: Path | None) -> Path:
    """Return the file of weights: the published one in the folder, else our own.

    Our own shipped weights are not for a folder that does not exist: its name was meant for others.
    """
    published = architecture.published
    if weights_dir is None or not (weights_dir / published.file_name).is_file():
        own = own_path(architecture.name, weights_dir)
        if own is not None:
            return own
        if architecture.name in SHIPPED and (weights_dir is None or weights_dir.is_dir()):
            return shipped_path(architecture.name)
    return published_path(weights_dir, published)


def _load(
    architecture: Architecture, weights_dir: Path | None, inference: Inference, threads: int | None
) -> R2D2Extractor:
    path = weights_path(architecture, weights_dir)
    shipped = SHIPPED[architecture.name] if path == shipped_path(architecture.name) else None
    sha256 = shipped or sha256_of(path)
    graph = open_graph(architecture.name, sha256, weights_dir, inference, threads)
    if graph is not None:
        network = OpenVinoNetwork(graph, architecture.stride)
        return R2D2Extractor(architecture.name, sha256, network)
    from visloc.features.networks.r2d2.model import TorchNetwork, read_network

    read, sha256 = read_network(architecture, path, sha256=shipped)
    return R2D2Extractor(architecture.name, sha256, TorchNetwork(read))


class OpenVinoNetwork:
    """Computes the network with OpenVINO, and its heads with NumPy.

    Args:
        graph: gives x (1, 128, h, w), and weight (2, 128) and bias (2,) of the heads.
        stride: pixels of the image per pixel of x.
    """

    def __init__(self, graph: Graph, stride: int) -> None:
        self._graph, self._stride = graph, stride
        self.computed_with = graph.computed_with

    @contextmanager
    def look(self, image: NDArray[np.float32]) -> Iterator[Seen]:
        """Look at RGB (H, W, 3) in 0 to 255."""
        heads = squared_heads if self._stride == 1 else squared_heads_at_double_resolution
        # 39 MB at 640 x 480: copying them takes 2 to 4 % of the time.
        with self._graph.computed(image[None]) as (batch, weight, bias):
            features = batch[0]

            def descriptors(x: NDArray[np.intp], y: NDArray[np.intp]) -> NDArray[np.float32]:
                sampled = _sampled(features, x, y, self._stride)
                norms = np.maximum(np.linalg.norm(sampled, axis=1, keepdims=True), 1e-12)
                unit: NDArray[np.float32] = sampled / norms
                return unit

            yield Seen(heads(features, weight, bias), descriptors)


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
