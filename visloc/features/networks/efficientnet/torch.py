"""EfficientNet-Lite0 with torch: the reference, and the way of CUDA GPUs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from visloc.device import torch_device
from visloc.features.backends.torch import computed_with
from visloc.features.networks.efficientnet.model import Block


class TorchNetwork:
    """Computes the network with torch, on a CUDA GPU where there is one."""

    def __init__(self, blocks: Sequence[Block]) -> None:
        self._device = torch_device()
        self._network = nn.Sequential(*blocks).to(self._device)
        self.computed_with = computed_with(self._device)

    @torch.inference_mode()
    def look(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return what the last block makes of what ``network_input`` gives."""
        image = torch.from_numpy(pixels).to(self._device, memory_format=torch.channels_last)
        features: NDArray[np.float32] = self._network(image)[0].cpu().numpy()
        return features
