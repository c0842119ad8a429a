"""Convolutions for inference: fixed weights, batch norm folded in, fast memory layout."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

_EPSILON = 1e-5  # PyTorch's default for batch norms


def fold_batch_norm(
    weight: NDArray[Any], bias: NDArray[Any], mean: NDArray[Any], variance: NDArray[Any]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return weight (O, I, k, k) and bias (O,) of a convolution with its batch norm inside.

    The batch norm (mean and variance (O,), no affine part) follows the convolution:
    (w * x + b - mean) / sqrt(variance + 1e-5).
    """
    factor = 1.0 / np.sqrt(variance.astype(np.float64) + _EPSILON)
    folded_weight: NDArray[np.float64] = weight * factor[:, None, None, None]
    folded_bias: NDArray[np.float64] = (bias - mean) * factor
    return folded_weight, folded_bias


def fixed_convolution(
    weight: NDArray[Any],
    bias: NDArray[Any],
    *,
    stride: int = 1,
    dilation: int = 1,
    padding: int = 0,
) -> nn.Conv2d:
    """Return a float32 convolution that will not be trained; weight (O, I, k, k), bias (O,)."""
    outputs, inputs, kernel, _ = weight.shape
    convolution = nn.Conv2d(
        inputs, outputs, kernel, stride=stride, dilation=dilation, padding=padding
    )
    # channels_last is a quarter faster on CPUs when the input has the same layout.
    fast_weight = torch.tensor(weight, dtype=torch.float32).contiguous(
        memory_format=torch.channels_last
    )
    convolution.weight = nn.Parameter(fast_weight, requires_grad=False)
    convolution.bias = nn.Parameter(torch.tensor(bias, dtype=torch.float32), requires_grad=False)
    return convolution
