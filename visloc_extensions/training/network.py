"""The network while it learns: batch norms on their own, heads at full resolution."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from visloc.features.networks.r2d2.architecture import MEAN, STD, Architecture
from visloc.features.networks.r2d2.model import R2D2Network
from visloc_extensions.training.interpolation import weighted_squares


class Maps(NamedTuple):
    """What the network says about images of H x W pixels.

    Attributes:
        features: (B, h, w, 128) float32, x before it is enlarged to H x W by the stride.
        squared_length: (B, H, W) float32 of the enlarged x.
        reliability: (B, H, W) float32 in 0 to 1.
        repeatability: (B, H, W) float32 in 0 to 1.
    """

    features: Tensor
    squared_length: Tensor
    reliability: Tensor
    repeatability: Tensor

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the features."""
        return self.features.shape[1], self.features.shape[2]

    @property
    def stride(self) -> int:
        """Pixels per feature."""
        return self.reliability.shape[1] // self.features.shape[1]

    def halves(self) -> tuple[Maps, Maps]:
        """Return the maps of the first and of the second half of the images."""
        first, second = zip(*(each.chunk(2) for each in self), strict=True)
        return Maps(*first), Maps(*second)


class TrainableR2D2(R2D2Network):
    """R2D2 or Fast-R2D2, its heads at full resolution."""

    def __init__(self, architecture: Architecture) -> None:
        super().__init__(architecture)
        for name, values in (("mean", MEAN), ("std", STD)):
            scaled = torch.tensor(values)[:, None, None] / 255
            self.register_buffer(name, scaled, persistent=False)
        self.mean: Tensor
        self.std: Tensor

    def forward(self, images: Tensor, bf16: bool = False) -> Maps:
        """Look at RGB (B, 3, H, W) in 0 to 1, even sizes; with bf16, in that precision up to x."""
        # Each weight is used once: there is nothing to keep, least of all in a recording.
        with torch.autocast(images.device.type, torch.bfloat16, enabled=bf16, cache_enabled=False):
            normalized = ((images - self.mean) / self.std).contiguous(
                memory_format=torch.channels_last
            )
            x = self.features(normalized)
        x = x.float().permute(0, 2, 3, 1)
        weight, bias = self.heads.weight[:, :, 0, 0], self.heads.bias
        assert bias is not None
        weight = torch.cat([weight, torch.ones_like(weight[:1])])
        squares = weighted_squares(x, weight, self.architecture.stride)
        reliability, repeatability, squared_length = squares.unbind(dim=1)
        softplus = F.softplus(repeatability + bias[1])
        return Maps(
            x,
            squared_length,
            torch.sigmoid(reliability + bias[0]),
            softplus / (1 + softplus),
        )
