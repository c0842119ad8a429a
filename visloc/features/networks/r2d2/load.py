"""Makes the local features R2D2 and Fast-R2D2."""

from __future__ import annotations

from pathlib import Path

from visloc.features.backends.choice import choose_inference
from visloc.features.base import LocalFeatureExtractor
from visloc.features.networks.r2d2.extractor import Network, R2D2Extractor
from visloc.features.networks.r2d2.model import FAST_R2D2, R2D2, Architecture, read_network
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
    """Make Fast-R2D2 from ``faster2d2_WASF_N16.pt`` or ``faster2d2.safetensors`` in the folder."""
    return _load(FAST_R2D2, weights_dir, inference, threads)


def _load(
    architecture: Architecture, weights_dir: Path | None, inference: Inference, threads: int | None
) -> R2D2Extractor:
    network, weights_sha256 = read_network(architecture, weights_dir)
    computed: Network
    chosen = choose_inference(inference)
    if chosen is Inference.TORCH:
        from visloc.features.networks.r2d2.torch import TorchNetwork

        computed = TorchNetwork(network)
    else:
        from visloc.features.networks.r2d2.openvino import make_openvino_network

        computed = make_openvino_network(
            network, weights_sha256, in_8_bits=chosen is Inference.INT8, threads=threads
        )
    return R2D2Extractor(architecture.name, weights_sha256, computed)
