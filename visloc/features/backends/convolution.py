"""Convolutions for inference: batch norm folded in."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_EPSILON = 1e-5  # PyTorch's default for batch norms


def fold_batch_norm(
    weight: NDArray[Any],
    bias: NDArray[Any],
    mean: NDArray[Any],
    variance: NDArray[Any],
    *,
    gain: NDArray[Any] | float = 1.0,
    shift: NDArray[Any] | float = 0.0,
    epsilon: float = _EPSILON,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return weight (O, I, k, k) and bias (O,) of a convolution with its batch norm inside.

    The batch norm (all (O,)) follows the convolution:
    (w * x + b - mean) / sqrt(variance + epsilon) * gain + shift.
    """
    factor = gain / np.sqrt(variance.astype(np.float64) + epsilon)
    folded_weight: NDArray[np.float64] = weight * factor[:, None, None, None]
    folded_bias: NDArray[np.float64] = (bias - mean) * factor + shift
    return folded_weight, folded_bias
