"""ALIKED with torch: the reference, and the way of CUDA GPUs.

Nothing here makes the features of every pixel, which would be 128 numbers each: the score map
needs only sums of eight, and descriptors look at some of the pixels.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from visloc.features.backends.torch import computed_with, torch_device
from visloc.features.networks.aliked.model import (
    NUM_SAMPLES,
    Layers,
    Padding,
    Seen,
    padded,
    padding_of,
)

_MAX_OFFSET = 0.25  # of the longer side, for deformable convolutions and samples
_LEAST_NORM = 1e-12
_KEYPOINTS_AT_ONCE = 4096  # bounds the memory that their samples take


class TorchNetwork:
    """Computes the network with torch, on a CUDA GPU where there is one."""

    def __init__(self, layers: Layers) -> None:
        self._device = torch_device()
        self._convolutions = {
            name: (
                torch.tensor(layer.weight, device=self._device).contiguous(
                    memory_format=torch.channels_last
                ),
                torch.tensor(layer.bias, device=self._device),
            )
            for name, layer in layers.convolutions.items()
        }
        self._aggregation = torch.tensor(layers.aggregation, device=self._device)
        self.computed_with = computed_with(self._device)

    @torch.inference_mode()
    def look(self, rgb: NDArray[np.uint8]) -> Seen:
        """Look at an image (H, W, 3) of any size."""
        height, width = rgb.shape[:2]
        padding = padding_of(height, width)
        pixels = torch.tensor(padded(rgb, padding), device=self._device)
        levels = self.levels(pixels.permute(2, 0, 1)[None].float() / 255)
        scores = self.scores(levels)[
            0, 0, padding.top : padding.top + height, padding.left : padding.left + width
        ]
        describe = partial(self._describe, levels, padding)
        return Seen(scores.contiguous().cpu().numpy(), describe)

    def levels(self, image: Tensor) -> tuple[Tensor, ...]:
        """Look at an image (1, 3, H, W) in 0..1 whose sides are multiples of 32.

        Returns what the four blocks give, each reduced to D / 4 channels, at a 1st, 2nd, 8th and
        32nd of the resolution.
        """
        x = image.contiguous(memory_format=torch.channels_last)
        reduced = []
        for block, shrink in enumerate((1, 2, 4, 4), 1):
            x = F.avg_pool2d(x, shrink) if shrink > 1 else x
            x = self._block(x, f"block{block}")
            reduced.append(F.selu(self._convolved(x, f"conv{block}"), inplace=True))
        return tuple(reduced)

    def _block(self, x: Tensor, name: str) -> Tensor:
        inner = F.selu(self._convolved(x, f"{name}.conv1"), inplace=True)
        result = self._convolved(inner, f"{name}.conv2")
        if f"{name}.downsample" in self._convolutions:
            result += self._convolved(x, f"{name}.downsample")
        return F.selu(result, inplace=True)

    def _convolved(self, x: Tensor, name: str) -> Tensor:
        weight, bias = self._convolutions[name]
        if f"{name}.offset_conv" in self._convolutions:
            limit = max(x.shape[2:]) * _MAX_OFFSET
            offsets = self._convolved(x, f"{name}.offset_conv").clamp(-limit, limit)
            return deformable_convolution(x, offsets, weight, bias)
        if weight.shape[2] == 1:
            return _combined(x, weight, bias)
        return F.conv2d(x, weight, bias, padding=weight.shape[2] // 2)

    def scores(self, levels: tuple[Tensor, ...]) -> Tensor:
        """Return the score map (1, 1, H, W) in 0..1.

        Its first layer, 1 x 1 and linear, is applied to the levels before they are enlarged.
        """
        weight, _ = self._convolutions["score_head.0"]
        weights = weight.chunk(4, dim=1)
        x = _combined(levels[0], weights[0])
        for level, part in zip(levels[1:], weights[1:], strict=True):
            x += F.interpolate(
                _combined(level, part), x.shape[2:], mode="bilinear", align_corners=True
            )
        for name in ("score_head.2", "score_head.4", "score_head.6"):
            x = self._convolved(F.selu(x, inplace=True), name)
        return torch.sigmoid(x)

    @torch.inference_mode()
    def _describe(
        self, levels: tuple[Tensor, ...], padding: Padding, places: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        chunks = torch.split(torch.tensor(places, device=self._device), _KEYPOINTS_AT_ONCE)
        found = [self.descriptors(levels, padding, chunk) for chunk in chunks]
        return torch.cat(found).cpu().numpy()

    def descriptors(self, levels: tuple[Tensor, ...], padding: Padding, places: Tensor) -> Tensor:
        """Return descriptors (N, D) of places (N, 2) in pixels without padding.

        The descriptor head of the paper (section IV.B): the 3 x 3 pixels around a keypoint say
        where to look. What lies outside the photo counts as zeros.
        """
        height, width = levels[0].shape[2:]
        photo = width - padding.left - padding.right, height - padding.top - padding.bottom
        size = torch.tensor(photo, device=places.device)
        corner = torch.tensor([padding.left, padding.top], device=places.device)
        around = torch.arange(-1, 2, device=places.device)
        window = torch.cartesian_prod(around, around).flip(1)  # (9, 2), x fastest
        # The whole pixel left and above: so it was when the network learned.
        centers = torch.minimum(places.long().clamp(min=1), size - 2)
        table, rows = pixel_features(levels, centers[:, None] + window + corner)
        weight, bias = self._convolutions["desc_head.offset_conv.0"]
        patches = F.embedding(rows, table).flatten(1)
        hidden = F.selu(F.linear(patches, weight.permute(0, 2, 3, 1).flatten(1), bias))
        weight, bias = self._convolutions["desc_head.offset_conv.2"]
        limit = max(photo) * _MAX_OFFSET
        offsets = F.linear(hidden, weight[:, :, 0, 0], bias).clamp(-limit, limit)
        samples = places[:, None] + offsets.reshape(len(places), 2, NUM_SAMPLES).transpose(1, 2)

        pixels, weights = bilinear(samples, size)
        table, rows = pixel_features(levels, pixels + corner)
        features = F.embedding_bag(
            rows.flatten(0, 1), table, per_sample_weights=weights.flatten(0, 1), mode="sum"
        )
        weight, _ = self._convolutions["desc_head.sf_conv"]
        features = F.selu(F.linear(features, weight[:, :, 0, 0]), inplace=True)
        aggregation = self._aggregation.flatten(0, 1)  # (16 D, D)
        summed = features.reshape(len(places), len(aggregation)) @ aggregation
        return F.normalize(summed, dim=1)


def deformable_convolution(x: Tensor, offsets: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Convolve x (1, I, h, w) with a kernel whose taps are moved, pixel by pixel.

    offsets (1, 2 k k, h, w): (dy, dx) of each tap, in the order of the kernel; weight
    (O, I, k, k); bias (O,). Between pixels x is interpolated, outside it is zero (Dai et al.,
    ICCV 2017, eq. 2 and 3).
    """
    _, _, height, width = x.shape
    kernel = weight.shape[2]
    taps = torch.arange(kernel, device=x.device) - kernel // 2
    moved = offsets.reshape(kernel, kernel, 2, height, width)
    down = moved[:, :, 0] + taps[:, None, None, None]
    down = down + torch.arange(height, device=x.device)[:, None]
    across = moved[:, :, 1] + taps[:, None, None] + torch.arange(width, device=x.device)
    # In the units of grid_sample the outer edges of the image are -1 and 1.
    grid = torch.stack([(2 * across + 1) / width - 1, (2 * down + 1) / height - 1], dim=-1)
    sampled = F.grid_sample(
        x, grid.reshape(1, kernel * kernel * height, width, 2), align_corners=False
    )
    columns = sampled.reshape(-1, height * width)  # (I k k, h w)
    result = weight.flatten(1) @ columns + bias[:, None]
    return result.reshape(1, -1, height, width).contiguous(memory_format=torch.channels_last)


def bilinear(places: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
    """Return the pixels (..., 4, 2) around places (..., 2), and their weights (..., 4).

    size: (width, height). Outside, the weight is zero and the pixel any.
    """
    lower = places.floor()
    steps = torch.tensor([[0, 0], [1, 0], [0, 1], [1, 1]], device=places.device)
    # With f = places - lower: 1 - f for step 0, f for step 1.
    weights = (1 - (places - lower)[..., None, :] - steps).abs().prod(dim=-1)
    pixels = lower.long()[..., None, :] + steps
    inside = ((pixels >= 0) & (pixels < size)).all(dim=-1)
    return torch.minimum(pixels.clamp(min=0), size - 1), weights * inside


def pixel_features(levels: tuple[Tensor, ...], pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Return the features (Q, D), of unit length, and for pixels (..., 2) the row of each (...).

    A pixel's features are those of all levels, interpolated such that the corner pixels of a
    level lie on the corner pixels of the image.
    """
    height, width = levels[0].shape[2:]
    flat = pixels[..., 1] * width + pixels[..., 0]
    needed = torch.zeros(height * width, dtype=torch.bool, device=flat.device)
    needed[flat.flatten()] = True
    row_of_pixel = needed.cumsum(0) - 1
    y, x = needed.reshape(height, width).nonzero(as_tuple=True)
    places = torch.stack([x, y], dim=-1)
    parts = [levels[0].permute(0, 2, 3, 1)[0, y, x]]
    for level in levels[1:]:
        size = torch.tensor([level.shape[3], level.shape[2]], device=flat.device)
        ratio = (size - 1) / torch.tensor([width - 1, height - 1], device=flat.device)
        corners, weights = bilinear(places * ratio, size)
        rows = corners[..., 1] * level.shape[3] + corners[..., 0]
        table = level.permute(0, 2, 3, 1).flatten(0, 2)  # (h w, C)
        parts.append(F.embedding_bag(rows, table, per_sample_weights=weights, mode="sum"))
    table = torch.cat(parts, dim=1)
    table *= 1 / torch.linalg.vector_norm(table, dim=1, keepdim=True).clamp_min(_LEAST_NORM)
    return table, row_of_pixel[flat]


def _combined(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """Convolve with a kernel of one pixel: a matrix product, faster as such."""
    return F.linear(x.permute(0, 2, 3, 1), weight[:, :, 0, 0], bias).permute(0, 3, 1, 2)
