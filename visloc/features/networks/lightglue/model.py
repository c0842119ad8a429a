"""Shape and use of LightGlue, and what it looks at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Design:
    """Shape and use of the network.

    Attributes:
        descriptor_dim: D, length of the local features' descriptors.
        width: numbers of a keypoint's state, in all heads together.
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
