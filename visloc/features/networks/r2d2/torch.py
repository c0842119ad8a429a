"""R2D2 and Fast-R2D2 with torch: the reference, and the way of CUDA GPUs."""

from __future__ import annotations

import contextlib

import numpy as np
import torch
from numpy.typing import NDArray

from visloc.device import torch_device
from visloc.features.backends.torch import computed_with
from visloc.features.networks.r2d2.extractor import Seen
from visloc.features.networks.r2d2.model import MEAN, STD, R2D2Network


class TorchNetwork:
    """Computes the network with torch, on a CUDA GPU where there is one."""

    def __init__(self, network: R2D2Network) -> None:
        self._device = torch_device()
        self.network = network.to(self._device)
        self._mean = torch.tensor(MEAN, device=self._device)[:, None, None]
        self._std = torch.tensor(STD, device=self._device)[:, None, None]
        self.computed_with = computed_with(self._device)

    @torch.inference_mode()
    def look(self, image: NDArray[np.float32]) -> contextlib.AbstractContextManager[Seen]:
        """Look at RGB (H, W, 3) in 0 to 255."""
        pixels = torch.tensor(image, device=self._device).permute(2, 0, 1)[None]
        normalized = ((pixels - self._mean) / self._std).contiguous(
            memory_format=torch.channels_last
        )
        half = torch.autocast("cuda") if self._device.type == "cuda" else contextlib.nullcontext()
        with half:
            features = self.network(normalized)
        # The heads square x: that is beyond the range of half precision.
        features = features.float()
        # One map after the other, as looking for peaks reads them.
        logits = self.network.logits(features).contiguous()

        @torch.inference_mode()
        def descriptors(x: NDArray[np.intp], y: NDArray[np.intp]) -> NDArray[np.float32]:
            columns, rows = (torch.from_numpy(each).to(self._device) for each in (x, y))
            found: NDArray[np.float32] = (
                self.network.descriptors(features, columns, rows).cpu().numpy()
            )
            return found

        return contextlib.nullcontext(Seen(logits.cpu().numpy(), descriptors))
