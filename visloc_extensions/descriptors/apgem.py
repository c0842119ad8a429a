"""AP-GeM: one vector of a photo by a residual network trained for average precision.

Revaud et al., "Learning with average precision: training image retrieval with a listwise loss"
(ICCV 2019): ResNet-101, generalized-mean pooling with a learned exponent, a fully connected layer
(2048), unit length; then the PCA whitening that the weights file brings along.

The layout of the file is that of github.com/naver/deep-image-retrieval: torchvision's names for
the network, ``adpool.p`` for the exponent, ``fc`` for the layer, and, beside the state dict,
``pca["Landmarks_clean"]``, a PCA of scikit-learn. No published weights were available here: the
architecture is tested against its definition, the accuracy is not measured.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from visloc.errors import refuse
from visloc.features.base import GlobalDescriptor
from visloc.features.descriptors.whitening import unit_rows
from visloc.features.weights.checkpoint import Checkpoint
from visloc.features.weights.files import PublishedWeights, check_shapes, read_weights
from visloc.options import Inference
from visloc.runtime.device import torch_device
from visloc_extensions.descriptors.network_descriptor import (
    NetworkDescriptor,
    exponent_of,
    linear_layer,
    normalized,
    shrunk_size,
    without_training,
)
from visloc_extensions.descriptors.pooling import generalized_mean
from visloc_extensions.descriptors.principal_components import (
    STAND_INS,
    PrincipalComponents,
    principal_components,
)
from visloc_extensions.descriptors.resnet import FEATURES, TORCHVISION, ResNet, expected_shapes

DEPTH = 101
# The authors describe photos as large as they are; their time grows with the pixels, and 1024 is
# the size at which others use this network for visual localization (Hierarchical-Localization).
MAX_LONG_SIDE_PX = 1024
PCA_NAME = "Landmarks_clean"
# A component is divided by its variance to this power; 0.5 would make all variances equal. It is
# what the authors evaluate with (whitenp).
WHITENING_POWER = 0.25

PUBLISHED = PublishedWeights(
    file_name="Resnet101-AP-GeM-LM18.pt",
    network="AP-GeM",
    source="table of pre-trained models of https://github.com/naver/deep-image-retrieval",
    licence="BSD 3-Clause",
    max_bytes=512 * 2**20,  # the network has 187 MiB, the PCA at most 48
)


def load_apgem(
    weights_dir: Path | None,
    _inference: Inference = Inference.AUTO,
    _threads: int | None = None,
) -> GlobalDescriptor:
    """Make AP-GeM from ``Resnet101-AP-GeM-LM18.pt`` in the weights folder; torch computes it.

    A file of the same layout without any PCA is whitened on the map instead.
    """
    with torch.serialization.safe_globals(STAND_INS):
        checkpoint = without_training(read_weights(weights_dir, PUBLISHED))
    shapes = {
        **expected_shapes(DEPTH, TORCHVISION),
        "adpool.p": (1,),
        "fc.weight": (FEATURES, FEATURES),
        "fc.bias": (FEATURES,),
    }
    check_shapes(checkpoint, shapes, network=PUBLISHED.network, held="another network")
    whitenings = checkpoint.beside.get("pca")
    if not isinstance(whitenings, dict) or not whitenings:
        return ApGem(checkpoint, None)
    return ApGem(checkpoint, _whitening(checkpoint.path, whitenings))


class ApGem(NetworkDescriptor):
    """Describes a photo by 2048 numbers."""

    def __init__(self, checkpoint: Checkpoint, pca: PrincipalComponents | None) -> None:
        parameters: dict[str, int | float | str] = {"max_long_side_px": MAX_LONG_SIDE_PX}
        if pca is not None:
            parameters |= {"pca": PCA_NAME, "pca_whitening_power": WHITENING_POWER}
        device = torch_device()
        super().__init__("apgem", parameters, checkpoint, device, whitened=pca is not None)
        self.exponent = exponent_of(checkpoint, "adpool.p")
        self.layer = linear_layer(checkpoint, "fc")
        self.network = ResNet(checkpoint.tensors, DEPTH, TORCHVISION).eval().to(device)
        self.pca = pca

    @torch.inference_mode()
    def look(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the vector (2048,), of unit length, of a photo (H, W, 3)."""
        height, width = rgb.shape[:2]
        size = shrunk_size(height, width, MAX_LONG_SIDE_PX)
        features = self.network(normalized(rgb, size, self.device))[0].cpu().numpy()
        weight, bias = self.layer
        raw = unit_rows(weight @ generalized_mean(features, self.exponent) + bias)
        return raw if self.pca is None else whitened(raw, self.pca)


def whitened(vectors: NDArray[np.float32], pca: PrincipalComponents) -> NDArray[np.float32]:
    """Project vectors (..., D) to rows (..., K) of unit length.

    y_i = c_i . (x - mean) / variance_i^0.25, then y / |y|; the division only for a PCA that says
    that it whitens. As naver/deep-image-retrieval with its options whitenp 0.25, whitenm 1 and
    all components.
    """
    projected = (vectors - pca.mean) @ pca.components.T
    if pca.whiten:
        projected /= pca.variances**WHITENING_POWER
    return unit_rows(projected.astype(np.float32))


def _whitening(path: Path, whitenings: Mapping[str, object]) -> PrincipalComponents:
    field = f"{path}, pca"
    pickled = whitenings.get(PCA_NAME)
    if pickled is None:
        raise refuse(
            "weights.network",
            "the file holds whitening, but not that of the published AP-GeM",
            field=field,
            expected=PCA_NAME,
            got=", ".join(sorted(map(str, whitenings))),
        )
    try:
        pca = principal_components(pickled)
    except ValueError as error:
        raise refuse(
            "weights.format",
            f"the whitening of AP-GeM cannot be read: {error}",
            field=field,
            expected="a PCA of scikit-learn",
        ) from error
    if len(pca.mean) != FEATURES:
        raise refuse(
            "weights.network",
            "the whitening belongs to another network",
            field=field,
            expected=f"a PCA of vectors of {FEATURES} numbers",
            got=str(len(pca.mean)),
        )
    return pca
