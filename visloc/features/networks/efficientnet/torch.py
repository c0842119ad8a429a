"""EfficientNet-Lite0 with torch: the reference, and the way of CUDA GPUs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from visloc.features.backends.torch import computed_with, fixed_convolution, torch_device
from visloc.features.networks.efficientnet.model import Block, Layer


class _BlockModule(nn.Module):
    def __init__(self, block: Block) -> None:
        super().__init__()
        self.steps = nn.Sequential(*(step for layer in block.layers for step in _steps(layer)))
        self.adds_input = block.adds_input

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.steps(x)
        return x + out if self.adds_input else out


def _steps(layer: Layer) -> list[nn.Module]:
    before, after = layer.padding
    uneven = before != after
    convolution = fixed_convolution(
        layer.weight,
        layer.bias,
        stride=layer.stride,
        padding=0 if uneven else before,
        groups=layer.groups,
    )
    return [
        *([nn.ZeroPad2d((before, after, before, after))] if uneven else []),
        convolution,
        *([nn.ReLU6(inplace=True)] if layer.relu6 else []),
    ]


class TorchNetwork:
    """Computes the network with torch, on a CUDA GPU where there is one."""

    def __init__(self, blocks: Sequence[Block]) -> None:
        self._device = torch_device()
        network = nn.Sequential(*(_BlockModule(block) for block in blocks))
        self._network = network.eval().to(self._device)
        self.computed_with = computed_with(self._device)

    @torch.inference_mode()
    def look(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return what the last block makes of what ``network_input`` gives."""
        image = torch.from_numpy(pixels).to(self._device, memory_format=torch.channels_last)
        features: NDArray[np.float32] = self._network(image)[0].cpu().numpy()
        return features
