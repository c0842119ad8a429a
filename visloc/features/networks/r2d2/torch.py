"""R2D2 and Fast-R2D2 with torch: the reference, and the way of CUDA GPUs."""

from __future__ import annotations

import contextlib

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from visloc.features.backends.torch import computed_with, torch_convolution
from visloc.features.networks.r2d2.extractor import Seen
from visloc.features.networks.r2d2.model import MEAN, STD, R2D2Network
from visloc.runtime.device import torch_device

_STRIP_ROWS = 32  # rows of x that the heads see at a time: bounds their memory


class R2D2Module(nn.Module):
    """The network for inference."""

    def __init__(self, network: R2D2Network) -> None:
        super().__init__()
        architecture = network.architecture
        self._stride = architecture.stride
        steps: list[nn.Module] = []
        layers = zip(architecture.layers, network.convolutions, strict=True)
        for number, (layer, convolution) in enumerate(layers, start=1):
            steps.append(torch_convolution(convolution))
            if layer.relu:
                steps.append(nn.ReLU(inplace=True))
            if number == architecture.pool_after:
                steps.append(nn.MaxPool2d(2))
        self._trunk = nn.Sequential(*steps)
        self._heads = torch_convolution(network.heads)

    def forward(self, image: Tensor) -> Tensor:
        """Return x, (1, 128, H // stride, W // stride), for a normalized image (1, 3, H, W)."""
        features: Tensor = self._trunk(image)
        return features

    def logits(self, features: Tensor) -> Tensor:
        """Return (2, H, W) logits of reliability and repeatability, at full resolution."""
        rows = features.shape[2]
        strips = []
        for top in range(0, rows, _STRIP_ROWS):
            bottom = min(top + _STRIP_ROWS, rows)
            if self._stride == 1:
                strip = features[:, :, top:bottom]
            else:  # one row more on either side makes the strips' seams exact
                first = max(top - 1, 0)
                strip = F.interpolate(
                    features[:, :, first : bottom + 1],
                    scale_factor=self._stride,
                    mode="bilinear",
                    align_corners=False,
                )
                strip = strip[:, :, self._stride * (top - first) : self._stride * (bottom - first)]
            strips.append(self._heads(strip.square()))
        return torch.cat(strips, dim=2)[0]

    def descriptors(self, features: Tensor, x: Tensor, y: Tensor) -> Tensor:
        """Return unit rows (N, 128) for pixels (x, y) of the full-resolution maps."""
        grid = features[0].permute(1, 2, 0)
        if self._stride == 1:
            return F.normalize(grid[y, x], dim=1)
        left, right, x_weight = _neighbours(x, self._stride, grid.shape[1])
        above, below, y_weight = _neighbours(y, self._stride, grid.shape[0])
        upper = torch.lerp(grid[above, left], grid[above, right], x_weight)
        lower = torch.lerp(grid[below, left], grid[below, right], x_weight)
        return F.normalize(torch.lerp(upper, lower, y_weight), dim=1)


def _neighbours(index: Tensor, stride: int, size: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return both neighbours at low resolution and the second one's weight, (N,), (N,), (N, 1)."""
    position = ((index + 0.5) / stride - 0.5).clamp(0, size - 1)
    lower = position.floor()
    upper = (lower + 1).clamp(max=size - 1)
    return lower.long(), upper.long(), (position - lower)[:, None]


class TorchNetwork:
    """Computes the network with torch, on a CUDA GPU where there is one."""

    def __init__(self, network: R2D2Network) -> None:
        self._device = torch_device()
        self._module = R2D2Module(network).to(self._device)
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
            features = self._module(normalized)
        # The heads square x: that is beyond the range of half precision.
        features = features.float()
        # One map after the other, as looking for peaks reads them.
        logits = self._module.logits(features).contiguous()

        @torch.inference_mode()
        def descriptors(x: NDArray[np.intp], y: NDArray[np.intp]) -> NDArray[np.float32]:
            columns, rows = (torch.from_numpy(each).to(self._device) for each in (x, y))
            found: NDArray[np.float32] = (
                self._module.descriptors(features, columns, rows).cpu().numpy()
            )
            return found

        return contextlib.nullcontext(Seen(logits.cpu().numpy(), descriptors))
