"""NetVLAD: one vector of a photo by VGG-16 and a trained VLAD.

Arandjelovic et al., "NetVLAD: CNN architecture for weakly supervised place recognition" (CVPR
2016): VGG-16 up to conv5_3, without the ReLU that follows; each position's 512 numbers scaled to
unit length; assigned softly to 64 clusters; per cluster the differences to its centre summed
(equation 4) and scaled to unit length; all of them, 64 x 512, to unit length; then whitened.

Two layouts of weights are understood, told apart by the tensors that are there:

- github.com/QVPR/Patch-NetVLAD: ``encoder.N`` (torchvision's numbers), ``pool.conv.weight``,
  ``pool.centroids`` and the whitening ``WPCA.0``;
- github.com/Nanne/pytorch-NetVlad: the same without ``WPCA.0``; whitening is learned on the map.

No published weights were available here: the architecture is tested against its definition, the
accuracy is not measured.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from visloc.features.backends.torch import for_inference
from visloc.features.base import GlobalDescriptor
from visloc.features.descriptors.whitening import unit_rows
from visloc.features.weights.checkpoint import Checkpoint
from visloc.features.weights.files import PublishedWeights, check_shapes, read_weights
from visloc.options import Inference
from visloc.runtime.device import torch_device
from visloc_extensions.descriptors.network_descriptor import (
    NetworkDescriptor,
    normalized,
    shrunk_size,
    without_training,
)

CLUSTERS = 64
# Widths of the 3 x 3 convolutions, up to each halving of the resolution.
VGG16 = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))
FEATURES = VGG16[-1][-1]
STRIDE = 2 ** (len(VGG16) - 1)
# Of the published ones; a file may declare more rows than it has numbers.
MAX_WHITENED_DIM = 4096
# Patch-NetVLAD's photos have 640 x 480 px.
MAX_LONG_SIDE_PX = 640

PUBLISHED = PublishedWeights(
    file_name="mapillary_WPCA4096.pth.tar",
    network="NetVLAD",
    source="https://github.com/QVPR/Patch-NetVLAD; or, under this name, the checkpoint of "
    "https://github.com/Nanne/pytorch-NetVlad",
    licence="MIT",
    max_bytes=1280 * 2**20,  # the whitening alone has 512 MiB, twice that in double precision
)


def load_netvlad(
    weights_dir: Path | None,
    _inference: Inference = Inference.AUTO,
    _threads: int | None = None,
) -> GlobalDescriptor:
    """Make NetVLAD from ``mapillary_WPCA4096.pth.tar`` in the weights folder; torch computes it."""
    checkpoint = without_training(read_weights(weights_dir, PUBLISHED))
    whitening = checkpoint.tensors.get("WPCA.0.weight")
    rows = None if whitening is None else whitening.size // (CLUSTERS * FEATURES)
    check_shapes(
        checkpoint,
        _expected_shapes(None if rows is None else min(rows, MAX_WHITENED_DIM)),
        network=PUBLISHED.network,
        held="another network",
    )
    return NetVlad(checkpoint)


class NetVlad(NetworkDescriptor):
    """Describes a photo by as many numbers as the whitening has rows, usually 4096."""

    def __init__(self, checkpoint: Checkpoint) -> None:
        tensors = checkpoint.tensors
        device = torch_device()
        super().__init__(
            "netvlad",
            {"max_long_side_px": MAX_LONG_SIDE_PX},
            checkpoint,
            device,
            whitened="WPCA.0.weight" in tensors,
        )
        self.encoder = make_vgg16(checkpoint).to(device)
        self.assignment, self.centroids = (
            torch.tensor(array, dtype=torch.float32, device=device)
            for array in (tensors["pool.conv.weight"][:, :, 0, 0], tensors["pool.centroids"])
        )
        self.whitening: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None
        if self.whitened:  # half a gigabyte: not copied if it has the right type
            weight = tensors["WPCA.0.weight"].reshape(-1, CLUSTERS * FEATURES)
            bias = tensors["WPCA.0.bias"]
            self.whitening = weight.astype(np.float32, copy=False), bias.astype(np.float32)

    @torch.inference_mode()
    def look(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the vector of unit length of a photo (H, W, 3): W v + b if weights whiten."""
        height, width = rgb.shape[:2]
        size = shrunk_size(height, width, MAX_LONG_SIDE_PX)
        image = normalized(rgb, size, self.device)
        # Below one position of the features there would be none.
        missing = [max(0, STRIDE - side) for side in size]
        image = F.pad(image, (0, missing[1], 0, missing[0]), mode="replicate")
        vector = vlad(self.encoder(image), self.assignment, self.centroids)
        raw: NDArray[np.float32] = vector.cpu().numpy()
        if self.whitening is None:
            return raw
        weight, bias = self.whitening
        return unit_rows(weight @ raw + bias)


def vlad(features: Tensor, assignment: Tensor, centroids: Tensor) -> Tensor:
    """Pool features (1, C, h, w) to (K * C,) of unit length, for K clusters.

    With x_i a position's features scaled to unit length and a_k(x_i) the softmax over the K
    clusters of ``assignment`` (K, C) times x_i, cluster k has sum_i a_k(x_i) (x_i - centroid_k).
    """
    x = F.normalize(features[0].flatten(1), dim=0)
    shares = F.softmax(assignment @ x, dim=0)
    sums = shares @ x.T - shares.sum(dim=1, keepdim=True) * centroids
    return F.normalize(F.normalize(sums, dim=1).flatten(), dim=0)


def make_vgg16(checkpoint: Checkpoint) -> nn.Sequential:
    """Return VGG-16 up to conv5_3: (1, 3, H, W) to (1, 512, H // 16, W // 16)."""
    steps: list[nn.Module] = []
    for stage, widths in enumerate(VGG16):
        if stage > 0:
            steps.append(nn.MaxPool2d(2))
        for _ in widths:
            name = f"encoder.{len(steps)}"
            weight, bias = (
                torch.tensor(checkpoint.tensors[f"{name}.{part}"], dtype=torch.float32)
                for part in ("weight", "bias")
            )
            convolution = nn.Conv2d(weight.shape[1], weight.shape[0], 3, padding=1)
            convolution.weight, convolution.bias = nn.Parameter(weight), nn.Parameter(bias)
            steps += [convolution, nn.ReLU(inplace=True)]
    return for_inference(nn.Sequential(*steps[:-1]))


def _expected_shapes(whitened_dim: int | None) -> dict[str, tuple[int, ...]]:
    shapes: dict[str, tuple[int, ...]] = {
        "pool.conv.weight": (CLUSTERS, FEATURES, 1, 1),
        "pool.centroids": (CLUSTERS, FEATURES),
    }
    if whitened_dim is not None:
        shapes["WPCA.0.weight"] = (whitened_dim, CLUSTERS * FEATURES, 1, 1)
        shapes["WPCA.0.bias"] = (whitened_dim,)
    index, inputs = 0, 3
    for widths in VGG16:
        for outputs in widths:
            shapes[f"encoder.{index}.weight"] = (outputs, inputs, 3, 3)
            shapes[f"encoder.{index}.bias"] = (outputs,)
            inputs = outputs
            index += 2  # a ReLU follows
        index += 1  # a halving of the resolution
    return shapes
