"""R2D2 (Revaud et al., NeurIPS 2019) and Fast-R2D2 (Humenberger et al. 2020, appendix).

Written from the papers and from the published weights' own shapes. Our own weights come from
``training``. One trunk of nine convolutions gives 128 channels x per pixel; two 1 x 1 heads on x^2
give reliability and repeatability; x / |x| is the descriptor. Fast-R2D2 pools once, so that most of
the trunk works at half resolution, and interpolates x back to full resolution before the heads.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from visloc.features.backends.torch import for_inference, load_strictly, shapes_of
from visloc.features.weights.checkpoint import Checkpoint
from visloc.features.weights.files import (
    FASTER2D2_WASF_N16,
    R2D2_WASF_N16,
    PublishedWeights,
    read_own_weights,
    read_weights,
)

DESCRIPTOR_DIM = 128
# Of RGB in 0 to 255; the networks see the difference to the mean in standard deviations.
MEAN = (0.485 * 255, 0.456 * 255, 0.406 * 255)
STD = (0.229 * 255, 0.224 * 255, 0.225 * 255)
_BASE_WIDTH, _MAX_BASE_WIDTH = 32, 1024
_STRIP_ROWS = 32  # rows of x that the heads see at a time: bounds their memory


class Layer(NamedTuple):
    """One convolution; padding keeps the size."""

    kernel: int
    dilation: int
    width: int  # output channels as a multiple of the first layer's; 0 for DESCRIPTOR_DIM
    normalized: bool
    relu: bool

    @property
    def padding(self) -> int:
        """Zeros around the input."""
        return self.dilation * (self.kernel - 1) // 2


@dataclass(frozen=True, slots=True)
class Architecture:
    """A network without its weights.

    Attributes:
        published: its published weights.
        pool_after: how many layers come before the pooling; 0 for no pooling.
    """

    name: str
    published: PublishedWeights
    layers: tuple[Layer, ...]
    pool_after: int

    @property
    def stride(self) -> int:
        """Pixels of the image per pixel of x."""
        return 2 if self.pool_after else 1

    def convolutions(self, base_width: int = _BASE_WIDTH) -> Iterator[tuple[Layer, nn.Conv2d]]:
        """Yield each layer with a new convolution."""
        inputs = 3
        for layer in self.layers:
            outputs = layer.width * base_width or DESCRIPTOR_DIM
            dilation, padding = layer.dilation, layer.padding
            yield (
                layer,
                nn.Conv2d(inputs, outputs, layer.kernel, dilation=dilation, padding=padding),
            )
            inputs = outputs


def _layers(dilations: tuple[int, ...]) -> tuple[Layer, ...]:
    kernels = (3, 3, 3, 3, 3, 3, 2, 2, 2)
    widths = (1, 1, 2, 2, 4, 4, 4, 4, 0)
    return tuple(
        Layer(kernel, dilation, width, normalized=number < 9, relu=number < 7)
        for number, (kernel, dilation, width) in enumerate(
            zip(kernels, dilations, widths, strict=True), start=1
        )
    )


R2D2 = Architecture("r2d2", R2D2_WASF_N16, _layers((1, 1, 1, 2, 2, 4, 4, 8, 16)), pool_after=0)
FAST_R2D2 = Architecture(
    "faster2d2", FASTER2D2_WASF_N16, _layers((1, 1, 1, 1, 1, 2, 2, 4, 8)), pool_after=3
)


class R2D2Network(nn.Module):
    """The network with the tensors' published names: ``ops.N``, ``clf`` and ``sal``.

    ``fuse`` makes it ready for inference: without batch norms, and with ``heads`` in place of
    ``clf`` and ``sal``, from x^2 to the logits of reliability and repeatability.
    """

    def __init__(self, architecture: Architecture, base_width: int = _BASE_WIDTH) -> None:
        super().__init__()
        self.architecture = architecture
        self.stride = architecture.stride
        steps: list[nn.Module] = []
        for number, (layer, convolution) in enumerate(architecture.convolutions(base_width), 1):
            steps.append(convolution)
            if layer.normalized:
                steps.append(nn.BatchNorm2d(convolution.out_channels, affine=False))
            if layer.relu:
                steps.append(nn.ReLU(inplace=True))
            if number == architecture.pool_after:
                steps.append(nn.MaxPool2d(2))
        self.ops = nn.Sequential(*steps)
        self.clf = nn.Conv2d(DESCRIPTOR_DIM, 2, 1)
        self.sal = nn.Conv2d(DESCRIPTOR_DIM, 1, 1)
        self.heads: nn.Conv2d

    def fuse(self) -> R2D2Network:
        """Put the batch norms into the convolutions, and make ``heads``."""
        self.eval()
        for number, step in enumerate(self.ops):
            if isinstance(step, nn.BatchNorm2d):
                before = self.ops[number - 1]
                assert isinstance(before, nn.Conv2d)
                assert before.bias is not None
                assert step.running_mean is not None
                # Subtracted in single precision, so that features stay those of earlier maps.
                bias = before.bias.float() - step.running_mean.float()
                before.bias = nn.Parameter(bias.to(before.weight.dtype))
                step.running_mean.zero_()
                self.ops[number - 1] = fuse_conv_bn_eval(before, step)
                self.ops[number] = nn.Identity()  # the others keep their names
        clf, sal = self.clf.state_dict(), self.sal.state_dict()
        self.heads = nn.Conv2d(DESCRIPTOR_DIM, 2, 1)
        # A softmax over two logits needs only their difference.
        self.heads.load_state_dict(
            {
                part: torch.cat([clf[part][1:] - clf[part][:1], sal[part]])
                for part in ("weight", "bias")
            },
            assign=True,
        )
        del self.clf, self.sal
        return self

    def convolutions(self) -> Iterator[nn.Conv2d]:
        """Yield those of the trunk in order."""
        return (step for step in self.ops if isinstance(step, nn.Conv2d))

    def forward(self, image: Tensor) -> Tensor:
        """Return x, (1, 128, H // stride, W // stride), for a normalized image (1, 3, H, W)."""
        features: Tensor = self.ops(image)
        return features

    def logits(self, features: Tensor) -> Tensor:
        """Return (2, H, W) logits of reliability and repeatability, at full resolution."""
        rows = features.shape[2]
        strips = []
        for top in range(0, rows, _STRIP_ROWS):
            bottom = min(top + _STRIP_ROWS, rows)
            if self.stride == 1:
                strip = features[:, :, top:bottom]
            else:  # one row more on either side makes the strips' seams exact
                first = max(top - 1, 0)
                strip = F.interpolate(
                    features[:, :, first : bottom + 1],
                    scale_factor=self.stride,
                    mode="bilinear",
                    align_corners=False,
                )
                strip = strip[:, :, self.stride * (top - first) : self.stride * (bottom - first)]
            strips.append(self.heads(strip.square()))
        return torch.cat(strips, dim=2)[0]

    def descriptors(self, features: Tensor, x: Tensor, y: Tensor) -> Tensor:
        """Return unit rows (N, 128) for pixels (x, y) of the full-resolution maps."""
        grid = features[0].permute(1, 2, 0)
        if self.stride == 1:
            return F.normalize(grid[y, x], dim=1)
        left, right, x_weight = _neighbours(x, self.stride, grid.shape[1])
        above, below, y_weight = _neighbours(y, self.stride, grid.shape[0])
        upper = torch.lerp(grid[above, left], grid[above, right], x_weight)
        lower = torch.lerp(grid[below, left], grid[below, right], x_weight)
        return F.normalize(torch.lerp(upper, lower, y_weight), dim=1)


def _neighbours(index: Tensor, stride: int, size: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return both neighbours at low resolution and the second one's weight, (N,), (N,), (N, 1)."""
    position = ((index + 0.5) / stride - 0.5).clamp(0, size - 1)
    lower = position.floor()
    upper = (lower + 1).clamp(max=size - 1)
    return lower.long(), upper.long(), (position - lower)[:, None]


def read_network(architecture: Architecture, weights_dir: Path | None) -> tuple[R2D2Network, str]:
    """Return the network and its file's sha256: the published one if there, else our own.

    Raises:
        WeightsError: the file is missing, damaged, or of another network.
    """
    published = architecture.published
    if weights_dir is None or not (weights_dir / published.file_name).is_file():
        own = read_own_weights(architecture.name, weights_dir)
        if own is not None:
            return unpack(architecture, own), own.sha256
    checkpoint = read_weights(weights_dir, published)
    return _from_published(architecture, checkpoint), checkpoint.sha256


def _from_published(architecture: Architecture, checkpoint: Checkpoint) -> R2D2Network:
    # Training on several GPUs puts "module." before every name.
    checkpoint = checkpoint.renamed(lambda name: name.removeprefix("module."))
    base_width = _base_width(checkpoint, "ops.0.weight")
    with torch.device("meta"):
        networks = {each: R2D2Network(each, base_width) for each in (R2D2, FAST_R2D2)}
    found = {name: array.shape for name, array in checkpoint.tensors.items()}
    held = next(
        (each.published.network for each in networks if shapes_of(networks[each]) == found),
        "another network",
    )
    network = networks[architecture]
    load_strictly(network, checkpoint, network_name=architecture.published.network, held=held)
    return for_inference(network.fuse())


def _base_width(checkpoint: Checkpoint, name: str) -> int:
    first = checkpoint.tensors.get(name)
    if first is None or not first.ndim:
        return _BASE_WIDTH
    return min(len(first), _MAX_BASE_WIDTH)  # a file may declare more than it has


def pack(network: R2D2Network) -> dict[str, NDArray[Any]]:
    """Return the tensors of a file of our own: weights in 16 bits, biases in 32.

    ``NAME.convolutions.N.weight`` and ``.bias`` count from 0; ``NAME.heads.weight`` is (2, 128).
    """
    names = {theirs: ours for ours, theirs in _own_names(network).items()}
    tensors = {names[name]: tensor.numpy() for name, tensor in network.state_dict().items()}
    heads = f"{network.architecture.name}.heads.weight"
    tensors[heads] = tensors[heads][:, :, 0, 0]
    # In the usual order of memory, as safetensors writes it whatever the order is.
    return {
        name: array.astype(np.float16, order="C") if name.endswith(".weight") else array
        for name, array in tensors.items()
    }


def unpack(architecture: Architecture, checkpoint: Checkpoint) -> R2D2Network:
    """Return the network of a file of our own, see ``pack``.

    Raises:
        WeightsError: ``weights.network`` or ``weights.values``.
    """
    with torch.device("meta"):
        base_width = _base_width(checkpoint, f"{architecture.name}.convolutions.0.weight")
        network = R2D2Network(architecture, base_width).fuse()
    names = _own_names(network)
    renamed = checkpoint.renamed(lambda name: names.get(name, name))
    tensors = dict(renamed.tensors)
    if tensors.get("heads.weight", np.empty(())).ndim == 2:
        tensors["heads.weight"] = tensors["heads.weight"][:, :, None, None]
    load_strictly(
        network,
        replace(renamed, tensors=tensors),
        network_name=architecture.published.network,
        held="another network",
    )
    return for_inference(network)


def _own_names(network: R2D2Network) -> Mapping[str, str]:
    """Return the name in the network of each tensor in a file of our own."""
    positions = [n for n, step in enumerate(network.ops) if isinstance(step, nn.Conv2d)]
    places = {f"convolutions.{number}": f"ops.{n}" for number, n in enumerate(positions)}
    return {
        f"{network.architecture.name}.{ours}.{part}": f"{theirs}.{part}"
        for ours, theirs in {**places, "heads": "heads"}.items()
        for part in ("weight", "bias")
    }
