"""DELG's global descriptor: one vector of a photo by a residual network trained on landmarks.

Cao et al., "Unifying deep local and global features for image search" (ECCV 2020): ResNet-50 or
101, generalized-mean pooling (exponent 3), a fully connected layer that whitens; for each of three
scales, scaled to unit length, averaged, and scaled to unit length again.

The authors publish TensorFlow models only. The layout understood here is that of the PyTorch
implementation github.com/feymanpriv/DELG: under the key ``model_state``, ``globalmodel.stem``,
``.s1`` to ``.s4``, ``.head.pool.p`` (the exponent, which it learns) and ``.head.fc``, whose rows
say how long the vector is. Its network sees blue, green, red. The local features (``localmodel``)
and the classifiers of the training (``desc_cls``, ``att_cls``) are left out. No published
weights were available: tests compare the architecture with its definition, and its accuracy is not
measured.
"""

from __future__ import annotations

from math import sqrt
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

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
from visloc_extensions.descriptors.resnet import FEATURES, Layout, ResNet, depth_of, expected_shapes

SCALES = (1 / sqrt(2), 1.0, sqrt(2))
MAX_LONG_SIDE_PX = 1024  # at scale 1, as the authors' configuration has it

LAYOUT = Layout(
    stem=("globalmodel.stem.conv", "globalmodel.stem.bn"),
    block="globalmodel.s{stage}.b{number}.",
    first_block=1,
    convolutions=(("f.a", "f.a_bn"), ("f.b", "f.b_bn"), ("f.c", "f.c_bn")),
    shortcut=("proj", "bn"),
)
EXPONENT = "globalmodel.head.pool.p"
LAYER = "globalmodel.head.fc"
UNUSED = ("localmodel.", "desc_cls.", "att_cls.")

PUBLISHED = PublishedWeights(
    file_name="r50_delg_s512.pyth",
    network="DELG",
    source="https://github.com/feymanpriv/DELG",
    licence="MIT",
    max_bytes=1024 * 2**20,  # the classifiers and what the training noted are most of it
)


def load_delg(
    weights_dir: Path | None,
    _inference: Inference = Inference.AUTO,
    _threads: int | None = None,
) -> GlobalDescriptor:
    """Make DELG from ``r50_delg_s512.pyth`` in the weights folder; torch computes it.

    ResNet-50 or 101, as the tensors say.
    """
    checkpoint = without_training(read_weights(weights_dir, PUBLISHED), *UNUSED)
    layer = checkpoint.tensors.get(f"{LAYER}.weight")
    # At most as many as the paper's: a file may declare more rows than it has numbers.
    size = FEATURES if layer is None or layer.ndim == 0 else min(len(layer), FEATURES)
    depth = depth_of(checkpoint.tensors, LAYOUT)
    shapes = {
        **expected_shapes(depth, LAYOUT),
        EXPONENT: (1,),
        f"{LAYER}.weight": (size, FEATURES),
        f"{LAYER}.bias": (size,),
    }
    check_shapes(checkpoint, shapes, network=PUBLISHED.network, held="another network")
    return Delg(checkpoint, depth)


class Delg(NetworkDescriptor):
    """Describes a photo by as many numbers as the last layer has rows."""

    def __init__(self, checkpoint: Checkpoint, depth: int) -> None:
        device = torch_device()
        parameters: dict[str, int | float | str] = {
            "depth": depth,
            "max_long_side_px": MAX_LONG_SIDE_PX,
            "scales": ",".join(f"{scale:.4f}" for scale in SCALES),
        }
        super().__init__("delg", parameters, checkpoint, device, whitened=True)
        self.exponent = exponent_of(checkpoint, EXPONENT)
        self.layer = linear_layer(checkpoint, LAYER)
        self.network = ResNet(checkpoint.tensors, depth, LAYOUT).eval().to(device)

    @torch.inference_mode()
    def look(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the vector (D,), of unit length, of a photo (H, W, 3)."""
        height, width = shrunk_size(rgb.shape[0], rgb.shape[1], MAX_LONG_SIDE_PX)
        weight, bias = self.layer
        vectors = []
        for scale in SCALES:
            size = max(1, round(height * scale)), max(1, round(width * scale))
            image = normalized(rgb, size, self.device).flip(1)  # to blue, green, red
            features = self.network(image)[0].cpu().numpy()
            vectors.append(weight @ generalized_mean(features, self.exponent) + bias)
        mean: NDArray[np.float32] = unit_rows(np.stack(vectors)).mean(axis=0)
        return unit_rows(mean)
