"""The networks of which graphs can be made, and what has to be known of each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor, nn

from visloc.features.networks.r2d2 import load as r2d2
from visloc.features.networks.r2d2.architecture import FAST_R2D2, R2D2, Architecture
from visloc.features.networks.r2d2.model import normalized
from visloc.features.networks.r2d2.model import read_network as read_r2d2
from visloc.features.networks.xfeat import extractor as xfeat
from visloc.features.networks.xfeat.load import weights_path as xfeat_path
from visloc.features.networks.xfeat.model import read_network as read_xfeat
from visloc_extensions.descriptors.convvlad import NUM_BLOCKS
from visloc_extensions.descriptors.efficientnet import load as efficientnet
from visloc_extensions.descriptors.efficientnet.model import read_network as read_efficientnet


@dataclass(frozen=True, slots=True, eq=False)
class Exported:
    """A network as the core calls its graph.

    Attributes:
        module: what to compute, from one tensor.
        weights_sha256: of the file of weights.
        axes: of height and width in that tensor.
        side_px: height and width are multiples of it.
        input_of: makes that tensor of RGB (H, W, 3).
        in_floats: beginnings of the names of weights that are not rounded to 8 bits; None for none
            that is.
        constants: further outputs, after those of the module.
    """

    module: nn.Module
    weights_sha256: str
    axes: tuple[int, int]
    side_px: int
    input_of: Callable[[NDArray[np.uint8]], NDArray[np.float32]]
    in_floats: tuple[str, ...] | None = None
    constants: Sequence[NDArray[Any]] = ()


class _Called(nn.Module):
    """Computes a function of a network."""

    def __init__(self, network: nn.Module, function: Callable[[Tensor], Any]) -> None:
        super().__init__()
        self.network, self._function = network, function

    def forward(self, entered: Tensor) -> Any:
        return self._function(entered)


def _xfeat(weights_dir: Path) -> Exported:
    network, sha256 = read_xfeat(xfeat_path(weights_dir))
    # In 8 bits the first block and the keypoint head, which see the image itself, would move every
    # fifth keypoint.
    return Exported(
        _Called(network, network.look),
        sha256,
        axes=(2, 3),
        side_px=32,
        input_of=lambda rgb: xfeat.network_input(rgb)[None, None],
        in_floats=("skip1", "block1", "keypoint_head"),
    )


def _r2d2(architecture: Architecture, weights_dir: Path) -> Exported:
    network, sha256 = read_r2d2(architecture, r2d2.weights_path(architecture, weights_dir))
    heads = network.heads.state_dict()
    # The first convolution stays in floats: a hundredth of the work, and most of the error.
    return Exported(
        _Called(network, lambda pixels: network.features(normalized(pixels))),
        sha256,
        axes=(1, 2),
        side_px=1,
        input_of=lambda rgb: rgb[None].astype(np.float32),
        in_floats=("convolutions_0",),
        constants=(heads["weight"][:, :, 0, 0].numpy(), heads["bias"].numpy()),
    )


def _efficientnet(num_blocks: int | None, weights_dir: Path) -> Exported:
    network, sha256 = read_efficientnet(efficientnet.weights_path(weights_dir))
    return Exported(
        _Called(network, partial(network, num_blocks=num_blocks)),
        sha256,
        axes=(2, 3),
        side_px=efficientnet.CELL_PX,
        input_of=efficientnet.network_input,
    )


NETWORKS: Mapping[str, Callable[[Path], Exported]] = {
    "convvlad": partial(_efficientnet, NUM_BLOCKS),
    "faster2d2": partial(_r2d2, FAST_R2D2),
    "gem": partial(_efficientnet, None),
    "r2d2": partial(_r2d2, R2D2),
    "xfeat": _xfeat,
}
