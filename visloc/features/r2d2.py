"""R2D2 (Revaud et al., NeurIPS 2019) and Fast-R2D2 (Humenberger et al. 2020, appendix).

Written from the papers and from the published weights' own shapes. One trunk of nine
convolutions gives 128 channels x per pixel; two 1x1 heads on x^2 give reliability and
repeatability, x / |x| is the descriptor. Fast-R2D2 pools once, so that most of the trunk works
at half resolution, and interpolates x back to full resolution before the heads.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from visloc.features.base import Fingerprint, LocalFeatureExtractor
from visloc.features.checkpoint import Checkpoint
from visloc.features.convolution import fixed_convolution, fold_batch_norm
from visloc.features.weights import (
    FASTER2D2_WASF_N16,
    R2D2_WASF_N16,
    PublishedWeights,
    check_shapes,
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
_MIN_SHORT_SIDE_PX = 8  # below, a network of 51 px receptive field sees mostly padding
# Of the scales at which features could be looked for: first, last, step.
_LEVELS: Mapping[Extraction, tuple[int, int | None, int]] = {
    Extraction.FAST: (1, 2, 1),
    Extraction.DEFAULT: (1, None, 2),
    Extraction.ACCURATE: (0, None, 1),
}
_STRIP_ROWS = 32  # rows of x that the heads see at a time: bounds their memory
_MEAN = (0.485, 0.456, 0.406)
_STD = (0.229, 0.224, 0.225)


class _Layer(NamedTuple):
    """One convolution; padding keeps the size."""

    kernel: int
    dilation: int
    width: int  # output channels as a multiple of the first layer's; 0 for DESCRIPTOR_DIM
    normalized: bool
    relu: bool

    @property
    def padding(self) -> int:
        return self.dilation * (self.kernel - 1) // 2


@dataclass(frozen=True, slots=True)
class _Architecture:
    name: str
    published: PublishedWeights
    layers: tuple[_Layer, ...]
    pool_after: int  # this many layers; 0 for no pooling

    @property
    def stride(self) -> int:
        """Pixels of the image per pixel of x."""
        return 2 if self.pool_after else 1


def _layers(dilations: tuple[int, ...]) -> tuple[_Layer, ...]:
    kernels = (3, 3, 3, 3, 3, 3, 2, 2, 2)
    widths = (1, 1, 2, 2, 4, 4, 4, 4, 0)
    return tuple(
        _Layer(kernel, dilation, width, normalized=number < 9, relu=number < 7)
        for number, (kernel, dilation, width) in enumerate(
            zip(kernels, dilations, widths, strict=True), start=1
        )
    )


R2D2 = _Architecture("r2d2", R2D2_WASF_N16, _layers((1, 1, 1, 2, 2, 4, 4, 8, 16)), pool_after=0)
FAST_R2D2 = _Architecture(
    "faster2d2", FASTER2D2_WASF_N16, _layers((1, 1, 1, 1, 1, 2, 2, 4, 8)), pool_after=3
)


def load_r2d2(
    weights_dir: Path | None,
    inference: Inference = Inference.AUTO,  # noqa: ARG001 - torch only so far
    threads: int | None = None,  # noqa: ARG001 - torch only so far
) -> LocalFeatureExtractor:
    """Make R2D2 from ``r2d2_WASF_N16.pt`` in the weights folder.

    Raises:
        WeightsError: the file is missing, damaged, or of another network.
    """
    return _load(R2D2, weights_dir)


def load_faster2d2(
    weights_dir: Path | None,
    inference: Inference = Inference.AUTO,  # noqa: ARG001 - torch only so far
    threads: int | None = None,  # noqa: ARG001 - torch only so far
) -> LocalFeatureExtractor:
    """Make Fast-R2D2 from ``faster2d2_WASF_N16.pt`` in the weights folder.

    Raises:
        WeightsError: the file is missing, damaged, or of another network.
    """
    return _load(FAST_R2D2, weights_dir)


def _load(architecture: _Architecture, weights_dir: Path | None) -> R2D2Extractor:
    checkpoint = read_weights(weights_dir, architecture.published)
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
        network=architecture.published.network,
        held=held,
    )
    return R2D2Extractor(architecture, checkpoint)


def _shapes_of(checkpoint: Checkpoint) -> dict[str, tuple[int, ...]]:
    return {name: array.shape for name, array in checkpoint.tensors.items()}


class _Index(NamedTuple):
    """Where the tensors of one layer are in the state dict: ``ops.<convolution>.weight``."""

    convolution: int
    batch_norm: int


def _indices(architecture: _Architecture) -> Iterator[tuple[_Layer, _Index]]:
    """Count as the published networks do: each batch norm, ReLU and pooling takes a number."""
    position = 0
    for number, layer in enumerate(architecture.layers, start=1):
        yield layer, _Index(position, position + 1)
        position += 1 + layer.normalized + layer.relu + (number == architecture.pool_after)


def _prefix(checkpoint: Checkpoint) -> str:
    """Training on several GPUs puts ``module.`` before every name."""
    return "module." if "module.clf.weight" in checkpoint.tensors else ""


def _expected_shapes(
    architecture: _Architecture, checkpoint: Checkpoint
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


class R2D2Network(nn.Module):
    """The network at inference, batch norms folded into the convolutions."""

    def __init__(self, architecture: _Architecture, checkpoint: Checkpoint) -> None:
        super().__init__()
        prefix = _prefix(checkpoint)
        tensors = {name.removeprefix(prefix): array for name, array in checkpoint.tensors.items()}
        steps: list[nn.Module] = []
        for number, (layer, index) in enumerate(_indices(architecture), start=1):
            steps.append(_convolution(layer, index, tensors))
            if layer.relu:
                steps.append(nn.ReLU(inplace=True))
            if number == architecture.pool_after:
                steps.append(nn.MaxPool2d(2))
        self.stride = architecture.stride
        self.trunk = nn.Sequential(*steps)
        # softmax over two logits needs only their difference
        reliability = tensors["clf.weight"][1:] - tensors["clf.weight"][:1]
        reliability_bias = tensors["clf.bias"][1:] - tensors["clf.bias"][:1]
        self.heads = fixed_convolution(
            np.concatenate([reliability, tensors["sal.weight"]]),
            np.concatenate([reliability_bias, tensors["sal.bias"]]),
        )

    def forward(self, image: Tensor) -> Tensor:
        """Return x, (1, 128, H // stride, W // stride), for a normalized image (1, 3, H, W)."""
        features: Tensor = self.trunk(image)
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


def _convolution(layer: _Layer, index: _Index, tensors: Mapping[str, NDArray[Any]]) -> nn.Conv2d:
    weight = tensors[f"ops.{index.convolution}.weight"]
    bias = tensors[f"ops.{index.convolution}.bias"]
    if layer.normalized:
        batch_norm = f"ops.{index.batch_norm}"
        mean, variance = (tensors[f"{batch_norm}.running_{name}"] for name in ("mean", "var"))
        weight, bias = fold_batch_norm(weight, bias, mean, variance)
    return fixed_convolution(weight, bias, dilation=layer.dilation, padding=layer.padding)


class R2D2Extractor:
    """Multi-scale extraction with R2D2 or Fast-R2D2."""

    def __init__(self, architecture: _Architecture, checkpoint: Checkpoint) -> None:
        self.network = R2D2Network(architecture, checkpoint).eval()
        self.fingerprint = Fingerprint(
            name=architecture.name,
            revision=1,
            parameters={
                "scale_step": SCALE_STEP,
                "max_long_side_px": MAX_LONG_SIDE_PX,
                "min_long_side_px": MIN_LONG_SIDE_PX,
                "min_reliability": MIN_RELIABILITY,
                "min_repeatability": MIN_REPEATABILITY,
            },
            weights_sha256=checkpoint.sha256,
        )

    @property
    def descriptor_dim(self) -> int:
        """Length of one descriptor: 128."""
        return DESCRIPTOR_DIM

    @property
    def computed_with(self) -> str:
        """What computes it."""
        return f"torch {torch.__version__} on cpu"

    @torch.inference_mode()
    def extract(
        self,
        rgb: NDArray[np.uint8],
        *,
        max_keypoints: int,
        extraction: Extraction = Extraction.ACCURATE,
    ) -> LocalFeatures:
        """Return the strongest keypoints over all scales; see ``LocalFeatureExtractor``.

        Score: reliability times repeatability. The same corner may come from several scales.
        """
        height, width = rgb.shape[:2]
        found = [_no_features()]
        # In a uniform image the networks respond to the zero padding of its border.
        if (rgb != rgb[0, 0]).any():
            for scale, image in itertools.islice(_pyramid(rgb), *_LEVELS[extraction]):
                keypoints, descriptors, scores = self._detect(image, max_keypoints)
                size = torch.tensor([width / image.shape[3], height / image.shape[2]])
                found.append(
                    LocalFeatures(
                        # the pixel centre is half a pixel of the scaled image from its corner
                        keypoints=((keypoints + 0.5) * size).numpy(),
                        descriptors=descriptors.numpy(),
                        scores=scores.numpy(),
                        scales=np.full(len(scores), PATCH_PX / scale, np.float32),
                    )
                )
        return _strongest(found, max_keypoints)

    def _detect(self, image: Tensor, max_keypoints: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return array indices (x, y) (N, 2), descriptors and scores of one scale, best first."""
        features = self.network(image)
        reliability_logit, repeatability_logit = self.network.logits(features)
        reliability = torch.sigmoid(reliability_logit)
        softplus = F.softplus(repeatability_logit)
        repeatability = softplus / (1 + softplus)
        neighbourhood = F.max_pool2d(repeatability[None], 3, stride=1, padding=1)[0]
        y, x = torch.nonzero(
            (repeatability == neighbourhood)
            & (repeatability >= MIN_REPEATABILITY)
            & (reliability >= MIN_RELIABILITY),
            as_tuple=True,
        )
        scores = (reliability * repeatability)[y, x]
        best = torch.argsort(scores, descending=True, stable=True)[:max_keypoints]
        x, y = x[best], y[best]
        return torch.stack([x, y], dim=1), self.network.descriptors(features, x, y), scores[best]


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


def _pyramid(rgb: NDArray[np.uint8]) -> Iterator[tuple[float, Tensor]]:
    """Yield (scale, normalized image (1, 3, h, w)); each is made from the one before.

    That smooths more than one resampling of the photo would, and the networks' published
    figures depend on it.
    """
    image = torch.tensor(rgb).permute(2, 0, 1)[None].float() / 255
    image = (image - torch.tensor(_MEAN)[:, None, None]) / torch.tensor(_STD)[:, None, None]
    for scale, size, is_used in pyramid_sizes(*rgb.shape[:2]):
        if min(size) < _MIN_SHORT_SIDE_PX:
            return
        if image.shape[2:] != size:
            image = F.interpolate(image, size, mode="bilinear", align_corners=False)
        if is_used:
            yield scale, image.contiguous(memory_format=torch.channels_last)


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
