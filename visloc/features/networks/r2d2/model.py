"""R2D2 (Revaud et al., NeurIPS 2019) and Fast-R2D2 (Humenberger et al. 2020, appendix).

Written from the papers and from the published weights' own shapes. Our own weights come from
``training``. One trunk of nine
convolutions gives 128 channels x per pixel; two 1x1 heads on x^2 give reliability and
repeatability, x / |x| is the descriptor. Fast-R2D2 pools once, so that most of the trunk works
at half resolution, and interpolates x back to full resolution before the heads.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from visloc.features.backends.choice import choose_inference
from visloc.features.backends.convolution import fold_batch_norm
from visloc.features.base import Fingerprint, LocalFeatureExtractor
from visloc.features.local.subpixel import peak_offsets
from visloc.features.weights.checkpoint import Checkpoint
from visloc.features.weights.files import (
    FASTER2D2_WASF_N16,
    R2D2_WASF_N16,
    PublishedWeights,
    check_shapes,
    read_own_weights,
    read_weights,
)
from visloc.types import Extraction, Inference, LocalFeatures

DESCRIPTOR_DIM = 128
SCALE_STEP = 2**0.25
MAX_LONG_SIDE_PX = 1024
MIN_LONG_SIDE_PX = 256
MIN_RELIABILITY = 0.7
MIN_REPEATABILITY = 0.7
PATCH_PX = 32  # nominal diameter of what one descriptor describes, at scale 1
# Repeatability is trained to be high in blobs of some pixels, and Fast-R2D2's is interpolated from
# half the resolution: the pixels next to a peak alone say little about where it is.
PEAK_REACH_PX = 2
_MIN_SHORT_SIDE_PX = 8  # below, a network of 51 px receptive field sees mostly padding
# Of the scales at which features could be looked for: first, last, step.
_LEVELS: Mapping[Extraction, tuple[int, int | None, int]] = {
    Extraction.FAST: (1, 2, 1),
    Extraction.DEFAULT: (1, None, 2),
    Extraction.ACCURATE: (0, None, 1),
}
# The thresholds before the functions that lead to them, see _probabilities.
_MIN_RELIABILITY_LOGIT = math.log(MIN_RELIABILITY / (1 - MIN_RELIABILITY))
_MIN_REPEATABILITY_LOGIT = math.log(math.expm1(MIN_REPEATABILITY / (1 - MIN_REPEATABILITY)))
# Of RGB in 0 to 255; the networks see the difference to the mean in standard deviations.
MEAN = (0.485 * 255, 0.456 * 255, 0.406 * 255)
STD = (0.229 * 255, 0.224 * 255, 0.225 * 255)


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
    """A network but for its weights.

    Attributes:
        name: of the feature.
        published: its published weights.
        layers: of the trunk.
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


def load_r2d2(
    weights_dir: Path | None,
    inference: Inference = Inference.AUTO,
    threads: int | None = None,
) -> LocalFeatureExtractor:
    """Make R2D2 from ``r2d2_WASF_N16.pt`` or ``r2d2.safetensors`` in the weights folder.

    Raises:
        WeightsError: the file is missing, damaged, or of another network.
        InvalidInput: ``inference.unavailable``.
    """
    return _load(R2D2, weights_dir, inference, threads)


def load_faster2d2(
    weights_dir: Path | None,
    inference: Inference = Inference.AUTO,
    threads: int | None = None,
) -> LocalFeatureExtractor:
    """Make Fast-R2D2 from ``faster2d2_WASF_N16.pt`` or ``faster2d2.safetensors`` in the folder.

    Raises:
        WeightsError: the file is missing, damaged, or of another network.
        InvalidInput: ``inference.unavailable``.
    """
    return _load(FAST_R2D2, weights_dir, inference, threads)


def _load(
    architecture: Architecture, weights_dir: Path | None, inference: Inference, threads: int | None
) -> R2D2Extractor:
    folded, weights_sha256 = read_network(architecture, weights_dir)
    chosen = choose_inference(inference)
    network: Network
    if chosen is Inference.TORCH:
        from visloc.features.networks.r2d2.torch import TorchNetwork

        network = TorchNetwork(folded)
    else:
        from visloc.features.networks.r2d2.openvino import make_openvino_network

        network = make_openvino_network(
            folded, weights_sha256, in_8_bits=chosen is Inference.INT8, threads=threads
        )
    return R2D2Extractor(architecture, weights_sha256, network)


def read_network(architecture: Architecture, weights_dir: Path | None) -> tuple[FoldedNetwork, str]:
    """Return the network and its file's sha256: the published one if there, else our own."""
    published = architecture.published
    if weights_dir is None or not (weights_dir / published.file_name).is_file():
        own = read_own_weights(architecture.name, weights_dir)
        if own is not None:
            return unpack_folded(architecture, own), own.sha256
    checkpoint = read_weights(weights_dir, published)
    held = next(
        (
            candidate.published.network
            for candidate in (R2D2, FAST_R2D2)
            if _shapes_of(checkpoint) == _expected_shapes(candidate, checkpoint)
        ),
        "another network",
    )
    check_shapes(
        checkpoint,
        _expected_shapes(architecture, checkpoint),
        network=published.network,
        held=held,
    )
    return fold(architecture, checkpoint), checkpoint.sha256


def _shapes_of(checkpoint: Checkpoint) -> dict[str, tuple[int, ...]]:
    return {name: array.shape for name, array in checkpoint.tensors.items()}


class _Index(NamedTuple):
    """Where the tensors of one layer are in the state dict: ``ops.<convolution>.weight``."""

    convolution: int
    batch_norm: int


def _indices(architecture: Architecture) -> Iterator[tuple[Layer, _Index]]:
    """Count as the published networks do: each batch norm, ReLU and pooling takes a number."""
    position = 0
    for number, layer in enumerate(architecture.layers, start=1):
        yield layer, _Index(position, position + 1)
        position += 1 + layer.normalized + layer.relu + (number == architecture.pool_after)


def _prefix(checkpoint: Checkpoint) -> str:
    """Training on several GPUs puts ``module.`` before every name."""
    return "module." if "module.clf.weight" in checkpoint.tensors else ""


def _expected_shapes(
    architecture: Architecture, checkpoint: Checkpoint
) -> dict[str, tuple[int, ...]]:
    """Shapes of all tensors, for the width that the first layer of the checkpoint has."""
    prefix = _prefix(checkpoint)
    first = checkpoint.tensors.get(f"{prefix}ops.0.weight")
    base_width = first.shape[0] if first is not None and first.ndim else 32
    shapes: dict[str, tuple[int, ...]] = {}
    inputs = 3
    for layer, index in _indices(architecture):
        outputs = layer.width * base_width or DESCRIPTOR_DIM
        convolution = f"{prefix}ops.{index.convolution}"
        shapes[f"{convolution}.weight"] = (outputs, inputs, layer.kernel, layer.kernel)
        shapes[f"{convolution}.bias"] = (outputs,)
        if layer.normalized:
            batch_norm = f"{prefix}ops.{index.batch_norm}"
            shapes[f"{batch_norm}.running_mean"] = (outputs,)
            shapes[f"{batch_norm}.running_var"] = (outputs,)
            shapes[f"{batch_norm}.num_batches_tracked"] = ()
        inputs = outputs
    for head, num_logits in (("clf", 2), ("sal", 1)):
        shapes[f"{prefix}{head}.weight"] = (num_logits, DESCRIPTOR_DIM, 1, 1)
        shapes[f"{prefix}{head}.bias"] = (num_logits,)
    return shapes


@dataclass(frozen=True, slots=True, eq=False)
class Convolution:
    """One convolution with its batch norm inside, and what follows it.

    Attributes:
        name: of the convolution in the state dict.
        weight: (O, I, k, k) float32.
        bias: (O,) float32.
        dilation: distance of the kernel's taps.
        padding: zeros around the input, which keep the size.
        relu: whether negative values become zero.
        pool: whether 2 x 2 pixels then become one, the largest.
    """

    name: str
    weight: NDArray[np.float32]
    bias: NDArray[np.float32]
    dilation: int
    padding: int
    relu: bool
    pool: bool


@dataclass(frozen=True, slots=True, eq=False)
class FoldedNetwork:
    """The network at inference.

    Attributes:
        name: of the architecture.
        convolutions: from the normalized image (1, 3, H, W) to features x.
        head_weight: (2, 128) float32, from x^2 to the logits of reliability and repeatability.
        head_bias: (2,) float32.
        stride: pixels of the image per pixel of x, 1 or 2. The heads see x at full resolution.
    """

    name: str
    convolutions: tuple[Convolution, ...]
    head_weight: NDArray[np.float32]
    head_bias: NDArray[np.float32]
    stride: int


def fold(architecture: Architecture, checkpoint: Checkpoint) -> FoldedNetwork:
    """Fold the batch norms of a checkpoint of this architecture into the convolutions."""
    prefix = _prefix(checkpoint)
    tensors = {name.removeprefix(prefix): array for name, array in checkpoint.tensors.items()}
    convolutions = tuple(
        _folded(layer, index, tensors, pool=number == architecture.pool_after)
        for number, (layer, index) in enumerate(_indices(architecture), start=1)
    )
    # softmax over two logits needs only their difference
    reliability = tensors["clf.weight"][1:] - tensors["clf.weight"][:1]
    reliability_bias = tensors["clf.bias"][1:] - tensors["clf.bias"][:1]
    head_weight = np.concatenate([reliability, tensors["sal.weight"]])[:, :, 0, 0]
    head_bias = np.concatenate([reliability_bias, tensors["sal.bias"]])
    return FoldedNetwork(
        architecture.name,
        convolutions,
        head_weight.astype(np.float32),
        head_bias.astype(np.float32),
        architecture.stride,
    )


def _folded(
    layer: Layer, index: _Index, tensors: Mapping[str, NDArray[Any]], *, pool: bool
) -> Convolution:
    name = f"ops.{index.convolution}"
    weight, bias = tensors[f"{name}.weight"], tensors[f"{name}.bias"]
    if layer.normalized:
        batch_norm = f"ops.{index.batch_norm}"
        mean, variance = (tensors[f"{batch_norm}.running_{part}"] for part in ("mean", "var"))
        weight, bias = fold_batch_norm(weight, bias, mean, variance)
    return Convolution(
        name,
        weight.astype(np.float32),
        bias.astype(np.float32),
        layer.dilation,
        layer.padding,
        layer.relu,
        pool,
    )


def pack_folded(folded: FoldedNetwork) -> dict[str, NDArray[Any]]:
    """Return the tensors of a file of our own: weights in 16 bits, biases in 32.

    ``NAME.convolutions.N.weight`` and ``.bias`` count from 0; ``NAME.heads.weight`` is (2, 128).
    """
    tensors: dict[str, NDArray[Any]] = {}
    for number, each in enumerate(folded.convolutions):
        tensors[f"{folded.name}.convolutions.{number}.weight"] = each.weight.astype(np.float16)
        tensors[f"{folded.name}.convolutions.{number}.bias"] = each.bias
    tensors[f"{folded.name}.heads.weight"] = folded.head_weight.astype(np.float16)
    tensors[f"{folded.name}.heads.bias"] = folded.head_bias
    return tensors


def unpack_folded(architecture: Architecture, checkpoint: Checkpoint) -> FoldedNetwork:
    """Return the network of a file of our own, see ``pack_folded``.

    Raises:
        WeightsError: ``weights.network`` or ``weights.values``.
    """
    name, tensors = architecture.name, checkpoint.tensors
    first = tensors.get(f"{name}.convolutions.0.weight")
    base_width = first.shape[0] if first is not None and first.ndim else 32
    shapes: dict[str, tuple[int, ...]] = {
        f"{name}.heads.weight": (2, DESCRIPTOR_DIM),
        f"{name}.heads.bias": (2,),
    }
    inputs = 3
    for number, layer in enumerate(architecture.layers):
        outputs = layer.width * base_width or DESCRIPTOR_DIM
        shape = (outputs, inputs, layer.kernel, layer.kernel)
        shapes[f"{name}.convolutions.{number}.weight"] = shape
        shapes[f"{name}.convolutions.{number}.bias"] = (outputs,)
        inputs = outputs
    check_shapes(checkpoint, shapes, network=architecture.published.network, held="another network")

    def tensor(of: str) -> NDArray[np.float32]:
        return tensors[f"{name}.{of}"].astype(np.float32)

    return FoldedNetwork(
        name,
        tuple(
            Convolution(
                f"convolutions.{number}",
                tensor(f"convolutions.{number}.weight"),
                tensor(f"convolutions.{number}.bias"),
                layer.dilation,
                layer.padding,
                layer.relu,
                number + 1 == architecture.pool_after,
            )
            for number, layer in enumerate(architecture.layers)
        ),
        tensor("heads.weight"),
        tensor("heads.bias"),
        architecture.stride,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """What a network makes of one image.

    Attributes:
        logits: (2, H, W) float32 of reliability and repeatability, for each pixel.
        descriptors: gives unit rows (N, 128) float32 for pixels x, y (N,) of the logits.
    """

    logits: NDArray[np.float32]
    descriptors: Callable[[NDArray[np.intp], NDArray[np.intp]], NDArray[np.float32]]


class Network(Protocol):
    """A way of computing the network. Safe to call from several threads."""

    @property
    def computed_with(self) -> str:
        """What computes it, for people."""

    def look(self, image: NDArray[np.float32]) -> AbstractContextManager[Seen]:
        """Look at RGB (H, W, 3) in 0 to 255; valid within the ``with`` statement only."""


class R2D2Extractor:
    """Multi-scale extraction with R2D2 or Fast-R2D2."""

    def __init__(self, architecture: Architecture, weights_sha256: str, network: Network) -> None:
        self.network = network
        self.fingerprint = Fingerprint(
            name=architecture.name,
            revision=2,
            parameters={
                "scale_step": SCALE_STEP,
                "max_long_side_px": MAX_LONG_SIDE_PX,
                "min_long_side_px": MIN_LONG_SIDE_PX,
                "min_reliability": MIN_RELIABILITY,
                "min_repeatability": MIN_REPEATABILITY,
                "peak_reach_px": PEAK_REACH_PX,
            },
            weights_sha256=weights_sha256,
        )

    @property
    def descriptor_dim(self) -> int:
        """Length of one descriptor: 128."""
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
        extraction: Extraction = Extraction.ACCURATE,
    ) -> LocalFeatures:
        """Return the strongest keypoints over all scales; see ``LocalFeatureExtractor``.

        Score: reliability times repeatability. The same corner may come from several scales.
        Keypoints are placed below the pixel, descriptors are those of the pixel.
        """
        height, width = rgb.shape[:2]
        found = [_no_features()]
        # In a uniform image the networks respond to the zero padding of its border.
        if (rgb != rgb[0, 0]).any():
            for scale, image in pyramid(rgb, extraction):
                keypoints, descriptors, scores = self._detect(image, max_keypoints)
                size = np.array([width / image.shape[1], height / image.shape[0]], np.float32)
                found.append(
                    LocalFeatures(
                        # the pixel centre is half a pixel of the scaled image from its corner
                        keypoints=(keypoints + np.float32(0.5)) * size,
                        descriptors=descriptors,
                        scores=scores,
                        scales=np.full(len(scores), PATCH_PX / scale, np.float32),
                    )
                )
        return _strongest(found, max_keypoints)

    def _detect(
        self, image: NDArray[np.float32], max_keypoints: int
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Return places (x, y) (N, 2), descriptors and scores of one scale's best.

        A place counts from the centre of the first pixel.
        """
        with self.network.look(image) as seen:
            x, y, scores = _peaks(seen.logits)
            # Row by row, as they lie in memory, which makes sampling faster.
            best = np.sort(np.argsort(-scores, kind="stable")[:max_keypoints])
            x, y = x[best], y[best]
            keypoints = np.stack([x, y], axis=1).astype(np.float32)
            keypoints += peak_offsets(
                seen.logits[1], x, y, reach=PEAK_REACH_PX, log_odds=_log_odds_of_repeatability
            )
            return keypoints, seen.descriptors(x, y), scores[best]


def _peaks(
    logits: NDArray[np.float32],
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float32]]:
    """Return x, y and scores (N,) where repeatability has a peak and both are high enough."""
    reliability, repeatability = logits
    if not logits.size:
        none = np.empty(0, np.intp)
        return none, none, np.empty(0, np.float32)
    # Both functions below rise with the logits: peaks and thresholds are found without them.
    highest = cv2.dilate(repeatability, np.ones((3, 3), np.uint8))
    is_peak = repeatability == highest
    is_peak &= repeatability >= _MIN_REPEATABILITY_LOGIT
    is_peak &= reliability >= _MIN_RELIABILITY_LOGIT
    found = np.flatnonzero(is_peak)
    y, x = np.divmod(found, logits.shape[2])
    softplus = np.logaddexp(np.float32(0), repeatability.ravel()[found])
    scores = softplus / (1 + softplus) / (1 + np.exp(-reliability.ravel()[found]))
    return x, y, scores


def _log_odds_of_repeatability(logits: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return log(p / (1 - p)) of p = softplus / (1 + softplus): the logarithm of softplus."""
    logits = np.maximum(logits, np.float32(-80))  # the softplus of less would be zero
    softplus = np.maximum(logits, 0) + np.log1p(np.exp(-np.abs(logits)))
    return np.asarray(np.log(softplus))


def pyramid_sizes(height: int, width: int) -> Iterator[tuple[float, tuple[int, int], bool]]:
    """Yield (scale, (height, width), whether to look for features), largest first.

    Scales are powers of 2^(-1/4). Features are looked for where the long side is within
    256 to 1024 px, in an image below that at its own size.
    """
    long_side = max(height, width)
    smallest = min(MIN_LONG_SIDE_PX / long_side, 1.0)
    scale = 1.0
    while scale + 0.001 >= smallest:
        size = (round(height * scale), round(width * scale))
        yield scale, size, scale - 0.001 <= MAX_LONG_SIDE_PX / long_side
        scale /= SCALE_STEP


def _levels_to_use(rgb_shape: tuple[int, ...], extraction: Extraction) -> set[float]:
    """Return the scales at which to look for features: those of the effort that there are."""
    scales = [
        scale
        for scale, size, is_used in pyramid_sizes(*rgb_shape[:2])
        if is_used and min(size) >= _MIN_SHORT_SIDE_PX
    ]
    first, last, step = _LEVELS[extraction]
    return set(scales[first:last:step] or scales[-1:])


def pyramid(
    rgb: NDArray[np.uint8], extraction: Extraction
) -> Iterator[tuple[float, NDArray[np.float32]]]:
    """Yield (scale, image (h, w, 3) in 0 to 255); each is made from the one before.

    That smooths more than one resampling of the photo would, and the networks' published
    figures depend on it.
    """
    image = rgb.astype(np.float32)
    remaining = _levels_to_use(rgb.shape, extraction)
    for scale, size, _ in pyramid_sizes(*rgb.shape[:2]):
        if not remaining:
            return
        if image.shape[:2] != size:
            smaller = cv2.resize(image, size[::-1], interpolation=cv2.INTER_LINEAR)
            image = np.asarray(smaller, np.float32)
        if scale in remaining:
            remaining.remove(scale)
            yield scale, image


def _no_features() -> LocalFeatures:
    return LocalFeatures(
        keypoints=np.empty((0, 2), np.float32),
        descriptors=np.empty((0, DESCRIPTOR_DIM), np.float32),
        scores=np.empty(0, np.float32),
        scales=np.empty(0, np.float32),
    )


def _strongest(found: list[LocalFeatures], max_keypoints: int) -> LocalFeatures:
    scores = np.concatenate([features.scores for features in found])
    best = np.argsort(-scores, kind="stable")[:max_keypoints]
    return LocalFeatures(
        keypoints=np.concatenate([features.keypoints for features in found])[best],
        descriptors=np.concatenate([features.descriptors for features in found])[best],
        scores=scores[best],
        scales=np.concatenate([features.scales for features in found])[best],
    )
