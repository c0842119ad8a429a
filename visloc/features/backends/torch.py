"""Convolutions in torch for inference: fixed weights, fast memory layout."""

from __future__ import annotations

from typing import Any

import torch
from numpy.typing import NDArray
from torch import nn


def fixed_convolution(
    weight: NDArray[Any],
    bias: NDArray[Any],
    *,
    stride: int = 1,
    dilation: int = 1,
    padding: int = 0,
    groups: int = 1,
) -> nn.Conv2d:
    """Return a float32 convolution that will not be trained; weight (O, I / groups, k, k)."""
    outputs, inputs_of_group, kernel, _ = weight.shape
    convolution = nn.Conv2d(
        inputs_of_group * groups,
        outputs,
        kernel,
        stride=stride,
        dilation=dilation,
        padding=padding,
        groups=groups,
    )
    # channels_last is a quarter faster on CPUs when the input has the same layout.
    fast_weight = torch.tensor(weight, dtype=torch.float32).contiguous(
        memory_format=torch.channels_last
    )
    convolution.weight = nn.Parameter(fast_weight, requires_grad=False)
    convolution.bias = nn.Parameter(torch.tensor(bias, dtype=torch.float32), requires_grad=False)
    return convolution


def torch_device() -> torch.device:
    """Return the CUDA GPU where there is one, else the processor."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def computed_with(device: torch.device) -> str:
    """Return what computes, for people."""
    name = torch.cuda.get_device_name() if device.type == "cuda" else device.type
    return f"torch {torch.__version__} on {name}"
