"""EfficientNet-Lite0 with torch: the reference, and the way of CUDA GPUs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from visloc.features.backends.torch import computed_with, torch_convolution
from visloc.features.networks.efficientnet.model import Block
from visloc.runtime.device import torch_device


class _BlockModule(nn.Module):
    def __init__(self, block: Block) -> None:
        super().__init__()
        steps: list[nn.Module] = []
        for convolution, relu6 in block.convolutions:
            steps += [torch_convolution(convolution), *([nn.ReLU6(inplace=True)] if relu6 else [])]
        self._steps = nn.Sequential(*steps)
        self._adds_input = block.adds_input

    def forward(self, entered: Tensor) -> Tensor:
        x: Tensor = self._steps(entered)
        return entered + x if self._adds_input else x


class TorchNetwork:
    """Computes the network with torch, on a CUDA GPU where there is one."""

    def __init__(self, blocks: Sequence[Block]) -> None:
        self._device = torch_device()
        self._network = nn.Sequential(*map(_BlockModule, blocks)).to(self._device)
        self.computed_with = computed_with(self._device)

    @torch.inference_mode()
    def look(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return what the last block makes of what ``network_input`` gives."""
        image = torch.from_numpy(pixels).to(self._device, memory_format=torch.channels_last)
        features: NDArray[np.float32] = self._network(image)[0].cpu().numpy()
        return features
