"""R2D2 (Revaud et al., NeurIPS 2019) and Fast-R2D2 (Humenberger et al. 2020, appendix).

Written from the papers and from the published weights' own shapes. Our own weights come from the
extension ``training``. One trunk of nine convolutions gives 128 channels x per pixel; two 1 x 1
heads on x^2 give reliability and repeatability; x / |x| is the descriptor. Fast-R2D2 pools once, so
that most of the trunk works at half resolution, and interpolates x back to full resolution before
the heads.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from visloc.features.backends.convolution import Convolution, batch_norm_shapes, folded
from visloc.features.weights.checkpoint import Checkpoint
from visloc.features.weights.files import (
    FASTER2D2_WASF_N16,
    R2D2_WASF_N16,
    PublishedWeights,
    Shapes,
    check_shapes,
    read_own_weights,
    read_weights,
)

DESCRIPTOR_DIM = 128
# Of RGB in 0 to 255; the networks see the difference to the mean in standard deviations.
MEAN = (0.485 * 255, 0.456 * 255, 0.406 * 255)
STD = (0.229 * 255, 0.224 * 255, 0.225 * 255)
_BASE_WIDTH, _MAX_BASE_WIDTH = 32, 1024


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

    def weight_shapes(self, base_width: int = _BASE_WIDTH) -> list[tuple[int, int, int, int]]:
        """Return the shape of each layer's weight."""
        widths = [3] + [layer.width * base_width or DESCRIPTOR_DIM for layer in self.layers]
        return [
            (outputs, inputs, layer.kernel, layer.kernel)
            for layer, inputs, outputs in zip(self.layers, widths, widths[1:], strict=False)
        ]


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


@dataclass(frozen=True, slots=True, eq=False)
class R2D2Network:
    """The network for inference.

    Attributes:
        architecture: without its numbers.
        convolutions: those of the trunk in order, batch norms inside.
        heads: from x^2 to the logits of reliability and repeatability; a softmax over two logits
            needs only their difference.
    """

    architecture: Architecture
    convolutions: tuple[Convolution, ...]
    heads: Convolution

    @staticmethod
    def of(
        architecture: Architecture, pairs: Sequence[tuple[NDArray[Any], NDArray[Any]]]
    ) -> R2D2Network:
        """Make it of weight and bias of each layer and, last, of the heads (2, 128)."""
        *trunk, (head_weight, head_bias) = (
            (np.ascontiguousarray(weight, np.float32), np.ascontiguousarray(bias, np.float32))
            for weight, bias in pairs
        )
        return R2D2Network(
            architecture,
            tuple(
                Convolution(
                    weight, bias, dilation=layer.dilation, padding=(layer.padding, layer.padding)
                )
                for layer, (weight, bias) in zip(architecture.layers, trunk, strict=True)
            ),
            Convolution(head_weight[:, :, None, None], head_bias),
        )


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
    shapes = {each: _published_shapes(each, base_width) for each in (R2D2, FAST_R2D2)}
    found = {name: array.shape for name, array in checkpoint.tensors.items()}
    held = next(
        (each.published.network for each in shapes if shapes[each] == found), "another network"
    )
    network = architecture.published.network
    check_shapes(checkpoint, shapes[architecture], network=network, held=held)
    tensors, pairs = checkpoint.tensors, []
    for layer, convolution, batch_norm in _published_names(architecture):
        weight, bias = (tensors[f"{convolution}.{part}"] for part in ("weight", "bias"))
        if layer.normalized:
            # Subtracted in single precision, so that features stay those of earlier maps.
            bias = bias.astype(np.float32) - tensors[f"{batch_norm}.running_mean"].astype(
                np.float32
            )
            centred = {**tensors, f"{batch_norm}.running_mean": np.zeros(len(bias))}
            weight, bias = folded(weight, bias, centred, batch_norm)
        pairs.append((weight, bias))
    clf, sal = (
        [tensors[f"{head}.{part}"].astype(np.float64) for part in ("weight", "bias")]
        for head in ("clf", "sal")
    )
    weight, bias = (np.concatenate([c[1:] - c[:1], s]) for c, s in zip(clf, sal, strict=True))
    return R2D2Network.of(architecture, [*pairs, (weight[:, :, 0, 0], bias)])


def _published_names(architecture: Architecture) -> Iterator[tuple[Layer, str, str]]:
    """Yield each layer with the names of its convolution and of the batch norm that may follow."""
    step = 0
    for number, layer in enumerate(architecture.layers, start=1):
        yield layer, f"ops.{step}", f"ops.{step + 1}"
        step += 1 + layer.normalized + layer.relu + (number == architecture.pool_after)


def _published_shapes(architecture: Architecture, base_width: int) -> Shapes:
    shapes: dict[str, tuple[int, ...]] = {}
    weights = architecture.weight_shapes(base_width)
    names = _published_names(architecture)
    for (layer, convolution, batch_norm), weight in zip(names, weights, strict=True):
        shapes |= {f"{convolution}.weight": weight, f"{convolution}.bias": weight[:1]}
        if layer.normalized:
            shapes |= batch_norm_shapes(batch_norm, weight[0])
    for head, outputs in (("clf", 2), ("sal", 1)):
        shapes[f"{head}.weight"] = (outputs, DESCRIPTOR_DIM, 1, 1)
        shapes[f"{head}.bias"] = (outputs,)
    return shapes


def _base_width(checkpoint: Checkpoint, name: str) -> int:
    first = checkpoint.tensors.get(name)
    if first is None or not first.ndim:
        return _BASE_WIDTH
    return min(len(first), _MAX_BASE_WIDTH)  # a file may declare more than it has


def pack(network: R2D2Network) -> dict[str, NDArray[Any]]:
    """Return the tensors of a file of our own: weights in 16 bits, biases in 32.

    ``NAME.convolutions.N.weight`` and ``.bias`` count from 0; ``NAME.heads.weight`` is (2, 128).
    """
    tensors: dict[str, NDArray[Any]] = {}
    names = _own_names(network.architecture)
    for name, convolution in zip(names, (*network.convolutions, network.heads), strict=True):
        tensors[f"{name}.weight"] = convolution.weight.astype(np.float16)
        tensors[f"{name}.bias"] = convolution.bias
    tensors[f"{names[-1]}.weight"] = tensors[f"{names[-1]}.weight"][:, :, 0, 0]
    return tensors


def unpack(architecture: Architecture, checkpoint: Checkpoint) -> R2D2Network:
    """Return the network of a file of our own, see ``pack``.

    Raises:
        WeightsError: ``weights.network`` or ``weights.values``.
    """
    names = _own_names(architecture)
    weights: list[tuple[int, ...]] = [
        *architecture.weight_shapes(_base_width(checkpoint, f"{names[0]}.weight")),
        (2, DESCRIPTOR_DIM),
    ]
    shapes: dict[str, tuple[int, ...]] = {}
    for name, weight in zip(names, weights, strict=True):
        shapes |= {f"{name}.weight": weight, f"{name}.bias": weight[:1]}
    network = architecture.published.network
    check_shapes(checkpoint, shapes, network=network, held="another network")
    tensors = checkpoint.tensors
    pairs = [(tensors[f"{name}.weight"], tensors[f"{name}.bias"]) for name in names]
    return R2D2Network.of(architecture, pairs)


def _own_names(architecture: Architecture) -> list[str]:
    """Return the names of the trunk's convolutions and, last, of the heads."""
    trunk = [f"convolutions.{number}" for number, _ in enumerate(architecture.layers)]
    return [f"{architecture.name}.{name}" for name in (*trunk, "heads")]
