"""Networks in torch for inference: fixed weights, fast memory layout."""

from __future__ import annotations

from typing import TypeVar

import torch
from torch import nn

from visloc.features.weights.checkpoint import Checkpoint
from visloc.features.weights.files import check_shapes

N = TypeVar("N", bound=nn.Module)


def shapes_of(network: nn.Module) -> dict[str, tuple[int, ...]]:
    """Return the shape of each tensor in the network's state dict."""
    return {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}


def load_strictly(
    network: nn.Module, checkpoint: Checkpoint, *, network_name: str, held: str
) -> None:
    """Give a network on the device ``meta`` the tensors of a checkpoint, in double precision.

    Args:
        checkpoint: with exactly the network's tensors.
        held: what the file seems to hold instead, for the message.
    """
    check_shapes(checkpoint, shapes_of(network), network=network_name, held=held)
    tensors = {name: torch.tensor(array) for name, array in checkpoint.tensors.items()}
    doubles = {
        name: tensor.double() if tensor.is_floating_point() else tensor
        for name, tensor in tensors.items()
    }
    network.load_state_dict(doubles, strict=True, assign=True)


def for_inference(network: N) -> N:
    """Make a network ready: single precision, no gradients, the memory layout fast on CPUs."""
    network.eval().float().requires_grad_(False)
    for parameter in network.parameters():
        if parameter.ndim == 4:
            # channels_last is a quarter faster when the input has the same layout.
            parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)
    return network


def computed_with(device: torch.device) -> str:
    """Return library and device, to show."""
    name = torch.cuda.get_device_name() if device.type == "cuda" else device.type
    return f"torch {torch.__version__} on {name}"
