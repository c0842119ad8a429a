"""The residual networks with 50 and 101 layers, for inference.

He et al., "Deep residual learning for image recognition" (CVPR 2016), table 1. As in torchvision
and in the networks published for AP-GeM and DELG, a block that halves the resolution does so in
its 3 x 3 convolution, not in the first 1 x 1.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from visloc.features.backends.torch import for_inference

BLOCKS: Mapping[int, tuple[int, ...]] = {50: (3, 4, 6, 3), 101: (3, 4, 23, 3)}
FEATURES = 2048
STRIDE = 32
_STEM_WIDTH = 64
_EXPANSION = 4  # a block gives out four times the width that it works at

_Tensors = Mapping[str, NDArray[Any]]


@dataclass(frozen=True, slots=True)
class Layout:
    """How a state dict names the convolutions, each with its batch norm.

    Attributes:
        block: what the names in a block begin with, for its stage (from 1) and number.
        first_block: number of the first block in a stage.
        convolutions: the three of a block.
        shortcut: of a block whose input has another shape than its output.
    """

    stem: tuple[str, str]
    block: str
    first_block: int
    convolutions: tuple[tuple[str, str], ...]
    shortcut: tuple[str, str]


TORCHVISION = Layout(
    stem=("conv1", "bn1"),
    block="layer{stage}.{number}.",
    first_block=0,
    convolutions=(("conv1", "bn1"), ("conv2", "bn2"), ("conv3", "bn3")),
    shortcut=("downsample.0", "downsample.1"),
)


@dataclass(frozen=True, slots=True)
class _Step:
    """A convolution without bias and its batch norm: names, widths, kernel, stride."""

    names: tuple[str, str]
    inputs: int
    outputs: int
    kernel: int
    stride: int = 1

    def shapes(self) -> Iterator[tuple[str, tuple[int, ...]]]:
        convolution, norm = self.names
        yield f"{convolution}.weight", (self.outputs, self.inputs, self.kernel, self.kernel)
        for part in ("weight", "bias", "running_mean", "running_var"):
            yield f"{norm}.{part}", (self.outputs,)

    def make(self, tensors: _Tensors) -> nn.Conv2d:
        """Return the convolution with the batch norm inside."""
        name, norm_name = self.names
        padding = self.kernel // 2
        convolution = nn.Conv2d(
            self.inputs, self.outputs, self.kernel, self.stride, padding, bias=False
        )
        norm = nn.BatchNorm2d(self.outputs)
        for module, prefix in ((convolution, name), (norm, norm_name)):
            parts = {part: tensors.get(f"{prefix}.{part}") for part in module.state_dict()}
            module.load_state_dict(
                {
                    # The counter of batches is not needed.
                    part: torch.tensor(0 if array is None else array)
                    for part, array in parts.items()
                }
            )
            module.double().eval()
        return for_inference(fuse_conv_bn_eval(convolution, norm))


def expected_shapes(depth: int, layout: Layout) -> dict[str, tuple[int, ...]]:
    """Return the shape of every tensor of the network but those of a head, by name."""
    steps = [_stem(layout)]
    for main, shortcut in _blocks(depth, layout):
        steps += [*main, *([] if shortcut is None else [shortcut])]
    return dict(shape for step in steps for shape in step.shapes())


def depth_of(tensors: _Tensors, layout: Layout) -> int:
    """Return 101 if the third stage has more blocks than a network with 50 layers, else 50."""
    further = layout.block.format(stage=3, number=BLOCKS[50][2] + layout.first_block)
    return 101 if any(name.startswith(further) for name in tensors) else 50


class ResNet(nn.Module):
    """The network without its head, batch norms folded into the convolutions."""

    def __init__(self, tensors: _Tensors, depth: int, layout: Layout) -> None:
        super().__init__()
        self.stem = _stem(layout).make(tensors)
        self.blocks = nn.Sequential(
            *(
                _Block(
                    [step.make(tensors) for step in main],
                    None if shortcut is None else shortcut.make(tensors),
                )
                for main, shortcut in _blocks(depth, layout)
            )
        )

    def forward(self, image: Tensor) -> Tensor:
        """Return (1, 2048, h, w) of (1, 3, H, W); h and w are H and W over 32, rounded up."""
        stem = F.max_pool2d(F.relu_(self.stem(image)), 3, stride=2, padding=1)
        features: Tensor = self.blocks(stem)
        return features


class _Block(nn.Module):
    def __init__(self, main: list[nn.Conv2d], shortcut: nn.Conv2d | None) -> None:
        super().__init__()
        self.first, self.second, self.third = main
        self.shortcut = shortcut

    def forward(self, x: Tensor) -> Tensor:
        residual: Tensor = self.third(F.relu_(self.second(F.relu_(self.first(x)))))
        residual += x if self.shortcut is None else self.shortcut(x)
        return F.relu_(residual)


def _stem(layout: Layout) -> _Step:
    return _Step(layout.stem, 3, _STEM_WIDTH, kernel=7, stride=2)


def _blocks(depth: int, layout: Layout) -> Iterator[tuple[tuple[_Step, ...], _Step | None]]:
    inputs = _STEM_WIDTH
    for stage, count in enumerate(BLOCKS[depth], start=1):
        width = _STEM_WIDTH * 2 ** (stage - 1)
        outputs = width * _EXPANSION
        for number in range(count):
            start = layout.block.format(stage=stage, number=number + layout.first_block)
            stride = 2 if stage > 1 and number == 0 else 1
            first, second, third = (
                (start + convolution, start + norm) for convolution, norm in layout.convolutions
            )
            main = (
                _Step(first, inputs, width, kernel=1),
                _Step(second, width, width, kernel=3, stride=stride),
                _Step(third, width, outputs, kernel=1),
            )
            shortcut = None
            if number == 0:
                convolution, norm = layout.shortcut
                names = start + convolution, start + norm
                shortcut = _Step(names, inputs, outputs, kernel=1, stride=stride)
            yield main, shortcut
            inputs = outputs
