"""Convolutions in torch for inference: fixed weights, fast memory layout."""

from __future__ import annotations

from typing import TypeVar

import torch
from torch import nn

from visloc.features.backends.convolution import Convolution
from visloc.features.weights.checkpoint import Checkpoint
from visloc.features.weights.files import check_shapes

N = TypeVar("N", bound=nn.Module)


def torch_convolution(convolution: Convolution) -> nn.Module:
    """Return a convolution that will not be trained: an ``nn.Conv2d`` if it pads evenly."""
    outputs, inputs_of_group, kernel, _ = convolution.weight.shape
    before, after = convolution.padding
    made = nn.Conv2d(
        inputs_of_group * convolution.groups,
        outputs,
        kernel,
        stride=convolution.stride,
        dilation=convolution.dilation,
        padding=before if before == after else 0,
        groups=convolution.groups,
    )
    # channels_last is a quarter faster on CPUs when the input has the same layout.
    weight = torch.tensor(convolution.weight).contiguous(memory_format=torch.channels_last)
    made.weight = nn.Parameter(weight, requires_grad=False)
    made.bias = nn.Parameter(torch.tensor(convolution.bias), requires_grad=False)
    return made if before == after else nn.Sequential(nn.ZeroPad2d((before, after) * 2), made)


def shapes_of(network: nn.Module) -> dict[str, tuple[int, ...]]:
    """Return the shape of each tensor in the network's state dict."""
    return {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}


def load_strictly(
    network: nn.Module, checkpoint: Checkpoint, *, network_name: str, held: str
) -> None:
    """Give a network on the device ``meta`` the tensors of a checkpoint, in double precision.

    Args:
        network: without values.
        checkpoint: with exactly the network's tensors.
        held: what the file seems to hold instead, for the message.

    Raises:
        WeightsError: those of ``check_shapes``.
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
