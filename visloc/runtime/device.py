"""The device that torch computes on."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch

# The driver's device files tell of a CUDA GPU without loading torch, which takes a second: of a
# graphics card, in WSL, and on a Jetson.
_CUDA_DEVICES = (Path("/dev/nvidiactl"), Path("/dev/dxg"), Path("/dev/nvhost-gpu"))


def may_have_cuda() -> bool:
    """Return whether there is the driver of a CUDA GPU, without loading torch."""
    return any(device.exists() for device in _CUDA_DEVICES)


@cache
def has_cuda() -> bool:
    """Return whether this process sees a CUDA GPU; ``CUDA_VISIBLE_DEVICES`` says which it sees."""
    if not may_have_cuda():
        return False
    import torch

    return torch.cuda.is_available()


def torch_device() -> torch.device:
    """Return the CUDA GPU where there is one, else the processor."""
    import torch

    return torch.device("cuda" if has_cuda() else "cpu")
