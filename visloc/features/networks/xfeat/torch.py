"""XFeat with torch: the reference, and the way of CUDA GPUs."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

from visloc.device import torch_device
from visloc.features.backends.torch import computed_with
from visloc.features.networks.xfeat.extractor import Seen
from visloc.features.networks.xfeat.model import CELL_PX, XFeatNetwork


class TorchNetwork:
    """Computes the network with torch, on a CUDA GPU where there is one."""

    def __init__(self, network: XFeatNetwork) -> None:
        self._device = torch_device()
        self.network = network.to(self._device)
        self.computed_with = computed_with(self._device)

    @torch.inference_mode()
    def look(self, grey: NDArray[np.float32]) -> Seen:
        """Look at a grey image (H, W) whose sides are multiples of 32."""
        pixels = torch.tensor(grey, device=self._device)[None, None]
        # Not in half precision: the layers are so small that conversions cost more than they save.
        features, logits, reliability = self.network(pixels)
        heat = F.pixel_shuffle(logits.softmax(dim=1)[:, :-1], CELL_PX)[0, 0]
        unit = F.normalize(features, dim=1)[0].permute(1, 2, 0).contiguous()
        return Seen(heat.cpu().numpy(), reliability[0, 0].cpu().numpy(), unit.cpu().numpy())
