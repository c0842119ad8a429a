"""The device that torch computes on."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch


@cache
def torch_device() -> torch.device:
    """Return the first CUDA GPU that this process sees, else the processor.

    ``CUDA_VISIBLE_DEVICES`` says which GPUs a process sees.
    """
    import torch  # takes a second to load, which not everything that imports this needs

    return torch.device("cuda" if torch.cuda.is_available() else "cpu")
