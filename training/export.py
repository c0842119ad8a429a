"""From a checkpoint of training to the weights that are shipped."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from training.checkpoint import State
from training.files import write_tensors
from training.network import ARCHITECTURES
from visloc.errors import refuse
from visloc.features.backends.convolution import fold_batch_norm
from visloc.features.networks.r2d2.model import Convolution, FoldedNetwork, pack_folded

LICENCE = "BSD-3-Clause"
_LARGEST_HALF = 65504.0


def folded_network(architecture_name: str, network: dict[str, Tensor]) -> FoldedNetwork:
    """Fold the batch norms of a state dict of ``TrainableR2D2`` into its convolutions."""
    architecture = ARCHITECTURES[architecture_name]
    tensors = {name: tensor.cpu().numpy() for name, tensor in network.items()}
    convolutions = []
    for number, layer in enumerate(architecture.layers):
        weight, bias = (tensors[f"convolutions.{number}.{part}"] for part in ("weight", "bias"))
        if layer.normalized:
            mean, variance = (
                tensors[f"batch_norms.{number}.running_{part}"] for part in ("mean", "var")
            )
            weight, bias = fold_batch_norm(weight, bias, mean, variance)
        convolutions.append(
            Convolution(
                f"convolutions.{number}",
                weight.astype(np.float32),
                bias.astype(np.float32),
                layer.dilation,
                layer.padding,
                layer.relu,
                number + 1 == architecture.pool_after,
            )
        )
    return FoldedNetwork(
        architecture.name,
        tuple(convolutions),
        tensors["heads.weight"][:, :, 0, 0],
        tensors["heads.bias"],
        architecture.stride,
    )


def export(state: State, output: Path) -> int:
    """Write a checkpoint as weights for ``visloc.features``; return the number of bytes.

    Raises:
        InvalidInput: ``training.range`` if a weight does not fit 16 bits.
    """
    folded = folded_network(state.settings.architecture, state.network)
    for each in folded.convolutions:
        largest = float(np.abs(each.weight).max())
        if not largest < _LARGEST_HALF:
            raise refuse(
                "training.range",
                field=each.name,
                expected=f"less than {_LARGEST_HALF}",
                got=largest,
            )
    about = {
        "format": "visloc folded R2D2, version 1",
        "architecture": folded.name,
        "licence": LICENCE,
        "step": str(state.step),
        "seconds": f"{state.seconds:.0f}",
        "settings": dataclasses.asdict(state.settings),
        "torch": torch.__version__,
        **state.sources,
    }
    return write_tensors(output, pack_folded(folded), about)
