"""ALIKED with torch: the reference, and the way of CUDA GPUs."""

from __future__ import annotations

from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from visloc.features.backends.torch import computed_with
from visloc.runtime.device import torch_device
from visloc_extensions.aliked.extractor import Seen, padded, padding_of
from visloc_extensions.aliked.model import AlikedNetwork, Padding

_KEYPOINTS_AT_ONCE = 4096  # bounds the memory that their samples take


class TorchNetwork:
    """Computes the network with torch, on a CUDA GPU where there is one."""

    def __init__(self, network: AlikedNetwork) -> None:
        self._device = torch_device()
        self._network = network.to(self._device)
        self.computed_with = computed_with(self._device)

    @torch.inference_mode()
    def look(self, rgb: NDArray[np.uint8]) -> Seen:
        """Look at an image (H, W, 3) of any size."""
        height, width = rgb.shape[:2]
        padding = padding_of(height, width)
        pixels = torch.tensor(padded(rgb, padding), device=self._device)
        levels = self._network.levels(pixels.permute(2, 0, 1)[None].float() / 255)
        scores = self._network.scores(levels)[
            0, 0, padding.top : padding.top + height, padding.left : padding.left + width
        ]
        describe = partial(self._describe, levels, padding)
        return Seen(scores.contiguous().cpu().numpy(), describe)

    @torch.inference_mode()
    def _describe(
        self, levels: tuple[Tensor, ...], padding: Padding, places: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        chunks = torch.split(torch.tensor(places, device=self._device), _KEYPOINTS_AT_ONCE)
        found = [self._network.descriptors(levels, padding, chunk) for chunk in chunks]
        return torch.cat(found).cpu().numpy()
