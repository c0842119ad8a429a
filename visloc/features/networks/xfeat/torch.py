"""XFeat with torch: the reference, the way of CUDA GPUs, and what training improves."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from visloc.features.backends.torch import computed_with, torch_convolution
from visloc.features.networks.xfeat.extractor import Seen
from visloc.features.networks.xfeat.model import CELL_PX, LAYERS, XFeatNetwork
from visloc.runtime.device import torch_device


class XFeatModule(nn.Module):
    """The network as a module, with the convolutions of ``LAYERS`` in their order."""

    def __init__(self, network: XFeatNetwork) -> None:
        super().__init__()
        self.convolutions = nn.ModuleList(map(torch_convolution, network.convolutions))
        self._blocks: dict[str, list[tuple[nn.Module, bool]]] = defaultdict(list)
        for layer, convolution in zip(LAYERS, self.convolutions, strict=True):
            self._blocks[layer.block].append((convolution, layer.normalized))

    def network(self) -> XFeatNetwork:
        """Return the network with the numbers that it has now."""
        arrays: dict[str, NDArray[np.float32]] = {}
        for layer, module in zip(LAYERS, self.convolutions, strict=True):
            tensors = module.get_parameter("weight"), module.get_parameter("bias")
            arrays |= zip(layer.shapes, (t.detach().cpu().numpy() for t in tensors), strict=True)
        return XFeatNetwork.of(arrays)

    def forward(self, grey: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Look at grey images (B, 1, H, W) in 0..1 whose sides are multiples of 32.

        Returns, for cells of 8 x 8 pixels: features (B, 64, H/8, W/8), keypoint logits
        (B, 65, H/8, W/8) and reliability (B, 1, H/8, W/8) in 0..1.
        """
        image = F.instance_norm(grey)
        skip = self._block("skip1", F.avg_pool2d(image, 4))
        eighth = self._block("block3", self._block("block2", self._block("block1", image) + skip))
        sixteenth = self._block("block4", eighth)
        thirty_second = self._block("block5", sixteenth)
        size = eighth.shape[2:]
        features = self._block(
            "block_fusion", eighth + _resized(sixteenth, size) + _resized(thirty_second, size)
        )
        reliability = torch.sigmoid(self._block("heatmap_head", features))
        logits = self._block("keypoint_head", F.pixel_unshuffle(image, CELL_PX))
        return features, logits, reliability

    def _block(self, name: str, x: Tensor) -> Tensor:
        for convolution, relu in self._blocks[name]:
            x = convolution(x)
            x = F.relu(x, inplace=True) if relu else x
        return x


def _resized(image: Tensor, size: tuple[int, ...]) -> Tensor:
    return F.interpolate(image, size, mode="bilinear", align_corners=False)


class TorchNetwork:
    """Computes the network with torch, on a CUDA GPU where there is one."""

    def __init__(self, network: XFeatNetwork) -> None:
        self._device = torch_device()
        self._module = XFeatModule(network).to(self._device)
        self.computed_with = computed_with(self._device)

    @torch.inference_mode()
    def look(self, grey: NDArray[np.float32]) -> Seen:
        """Look at a grey image (H, W) whose sides are multiples of 32."""
        pixels = torch.tensor(grey, device=self._device)[None, None]
        # Not in half precision: the layers are so small that conversions cost more than they save.
        features, logits, reliability = self._module(pixels)
        heat = F.pixel_shuffle(logits.softmax(dim=1)[:, :-1], CELL_PX)[0, 0]
        unit = F.normalize(features, dim=1)[0].permute(1, 2, 0).contiguous()
        return Seen(heat.cpu().numpy(), reliability[0, 0].cpu().numpy(), unit.cpu().numpy())
