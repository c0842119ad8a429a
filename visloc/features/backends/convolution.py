"""A trained convolution as arrays, which the backends of torch and OpenVINO share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

_EPSILON = 1e-5  # PyTorch's, added to variances

Tensors = Mapping[str, NDArray[Any]]


@dataclass(frozen=True, slots=True, eq=False)
class Convolution:
    """A convolution with a bias, for inference.

    Attributes:
        weight: (O, I / groups, k, k) float32.
        bias: (O,) float32.
        stride: in both directions.
        dilation: in both directions.
        padding: zeros before and after what enters, in both directions.
        groups: of channels that are convolved on their own.
    """

    weight: NDArray[np.float32]
    bias: NDArray[np.float32]
    stride: int = 1
    dilation: int = 1
    padding: tuple[int, int] = (0, 0)
    groups: int = 1


def folded(
    weight: NDArray[Any],
    bias: NDArray[Any],
    tensors: Tensors,
    batch_norm: str,
    epsilon: float = _EPSILON,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Fold a batch norm into the preceding convolution, in double precision.

    Args:
        weight: (O, I / groups, k, k).
        bias: (O,).
        tensors: with the mean and variance of the batch norm, and its gain and shift if it has any.
        batch_norm: its name.
        epsilon: added to the variance.

    Returns:
        Weight and bias of both together.
    """
    mean, variance = (
        tensors[f"{batch_norm}.{part}"].astype(np.float64)
        for part in ("running_mean", "running_var")
    )
    scale = 1 / np.sqrt(variance + epsilon)
    shift: NDArray[np.float64] | float = 0.0
    if f"{batch_norm}.weight" in tensors:
        scale = tensors[f"{batch_norm}.weight"].astype(np.float64) * scale
        shift = tensors[f"{batch_norm}.bias"].astype(np.float64)
    return (
        (weight.astype(np.float64) * scale[:, None, None, None]).astype(np.float32),
        ((bias.astype(np.float64) - mean) * scale + shift).astype(np.float32),
    )


def batch_norm_shapes(
    name: str, channels: int, *, affine: bool = False
) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the tensors of a batch norm, by their names."""
    parts = ("running_mean", "running_var", *(("weight", "bias") if affine else ()))
    return {
        **{f"{name}.{part}": (channels,) for part in parts},
        f"{name}.num_batches_tracked": (),
    }
