"""The network while it learns: batch norms on their own, heads at full resolution.

The layers are those of ``visloc.features.networks.r2d2.model``. ``folded`` makes the network there
of the one that was trained here.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from visloc.features.backends.convolution import folded
from visloc.features.networks.r2d2.model import (
    DESCRIPTOR_DIM,
    FAST_R2D2,
    MEAN,
    R2D2,
    STD,
    Architecture,
    R2D2Network,
)
from visloc_extensions.training.interpolation import weighted_squares

Array = NDArray[Any]
ARCHITECTURES = {each.name: each for each in (R2D2, FAST_R2D2)}


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


class TrainableR2D2(nn.Module):
    """R2D2 or Fast-R2D2 with batch norms without gain and shift, after every convolution but one.

    ``convolutions.N`` and ``batch_norms.N`` count the layers from 0; ``heads`` goes from x^2 to
    the logits of reliability and repeatability. Softmax over two logits, as the paper has it,
    knows only their difference: one logit and a sigmoid are the same.
    """

    def __init__(self, architecture: Architecture) -> None:
        super().__init__()
        self.architecture = architecture
        convolutions, batch_norms = [], []
        shapes = architecture.weight_shapes()
        for layer, (outputs, inputs, kernel, _) in zip(architecture.layers, shapes, strict=True):
            dilation, padding = layer.dilation, layer.padding
            convolutions.append(
                nn.Conv2d(inputs, outputs, kernel, dilation=dilation, padding=padding)
            )
            if layer.normalized:
                batch_norms.append(nn.BatchNorm2d(outputs, affine=False))
        self.convolutions = nn.ModuleList(convolutions)
        self.batch_norms = nn.ModuleList(batch_norms)
        self.heads = nn.Conv2d(DESCRIPTOR_DIM, 2, 1)
        for name, values in (("mean", MEAN), ("std", STD)):
            scaled = torch.tensor(values)[:, None, None] / 255
            self.register_buffer(name, scaled, persistent=False)
        self.mean: Tensor
        self.std: Tensor

    def folded(self) -> R2D2Network:
        """Return the network for inference, the batch norms inside the convolutions."""
        arrays = {name: tensor.cpu().numpy() for name, tensor in self.state_dict().items()}
        pairs = []
        for number, layer in enumerate(self.architecture.layers):
            pair = _pair(arrays, f"convolutions.{number}")
            pairs.append(
                folded(*pair, arrays, f"batch_norms.{number}") if layer.normalized else pair
            )
        weight, bias = _pair(arrays, "heads")
        return R2D2Network.of(self.architecture, [*pairs, (weight[:, :, 0, 0], bias)])

    def features(self, images: Tensor) -> Tensor:
        """Return x (B, 128, H // stride, W // stride) for RGB (B, 3, H, W) in 0 to 1."""
        x = ((images - self.mean) / self.std).contiguous(memory_format=torch.channels_last)
        for number, layer in enumerate(self.architecture.layers):
            x = self.convolutions[number](x)
            if layer.normalized:
                x = self.batch_norms[number](x)
            if layer.relu:
                x = F.relu(x)
            if number + 1 == self.architecture.pool_after:
                x = F.max_pool2d(x, 2)
        return x

    def forward(self, images: Tensor, bf16: bool = False) -> Maps:
        """Look at RGB (B, 3, H, W) in 0 to 1, even sizes; with bf16, in that precision up to x."""
        # Each weight is used once: there is nothing to keep, least of all in a recording.
        with torch.autocast(images.device.type, torch.bfloat16, enabled=bf16, cache_enabled=False):
            x = self.features(images)
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


def _pair(arrays: Mapping[str, Array], name: str) -> tuple[Array, Array]:
    return arrays[f"{name}.weight"], arrays[f"{name}.bias"]
