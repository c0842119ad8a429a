"""XFeat with torch: the reference, and the way of CUDA GPUs."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from visloc.features.backends.torch import computed_with, fixed_convolution, torch_device
from visloc.features.networks.xfeat.model import CELL_PX, Layer, Seen


class XFeatNetwork(nn.Module):
    """The network at inference, batch norms folded into the convolutions."""

    def __init__(self, blocks: Mapping[str, tuple[Layer, ...]]) -> None:
        super().__init__()
        for block, layers in blocks.items():
            steps: list[nn.Module] = [nn.AvgPool2d(4)] if block == "skip1" else []
            for layer in layers:
                padding = layer.weight.shape[2] // 2
                steps.append(
                    fixed_convolution(
                        layer.weight, layer.bias, stride=layer.stride, padding=padding
                    )
                )
                if layer.relu:
                    steps.append(nn.ReLU(inplace=True))
            self.add_module(block, nn.Sequential(*steps))

    def forward(self, grey: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Look at a grey image (1, 1, H, W) in 0..1 whose sides are multiples of 32.

        Returns, for cells of 8 x 8 pixels: features (1, 64, H/8, W/8), keypoint logits
        (1, 65, H/8, W/8) and reliability (1, 1, H/8, W/8) in 0..1.
        """
        image = F.instance_norm(grey)
        quarter = self.get_submodule("block2")(
            self.get_submodule("block1")(image) + self.get_submodule("skip1")(image)
        )
        eighth = self.get_submodule("block3")(quarter)
        sixteenth = self.get_submodule("block4")(eighth)
        thirty_second = self.get_submodule("block5")(sixteenth)
        size = eighth.shape[2:]
        fused = eighth + _resized(sixteenth, size) + _resized(thirty_second, size)
        features = self.get_submodule("block_fusion")(fused)
        reliability = torch.sigmoid(self.get_submodule("heatmap_head")(features))
        cells = F.pixel_unshuffle(image, CELL_PX)
        return features, self.get_submodule("keypoint_head")(cells), reliability


def _resized(image: Tensor, size: tuple[int, ...]) -> Tensor:
    return F.interpolate(image, size, mode="bilinear", align_corners=False)


class TorchNetwork:
    """Computes the network with torch, on a CUDA GPU where there is one."""

    def __init__(self, blocks: Mapping[str, tuple[Layer, ...]]) -> None:
        self._device = torch_device()
        self.network = XFeatNetwork(blocks).eval().to(self._device)
        self.computed_with = computed_with(self._device)

    @torch.inference_mode()
    def look(self, grey: NDArray[np.float32]) -> Seen:
        """Look at a grey image (H, W) whose sides are multiples of 32."""
        pixels = torch.tensor(grey, device=self._device)[None, None]
        half = torch.autocast("cuda") if self._device.type == "cuda" else contextlib.nullcontext()
        with half:
            features, logits, reliability = self.network(pixels)
        heat = F.pixel_shuffle(logits.float().softmax(dim=1)[:, :-1], CELL_PX)[0, 0]
        unit = F.normalize(features.float(), dim=1)[0].permute(1, 2, 0).contiguous()
        return Seen(heat.cpu().numpy(), reliability.float()[0, 0].cpu().numpy(), unit.cpu().numpy())
