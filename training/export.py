"""From a checkpoint of training to the weights that are shipped."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import torch

from training.checkpoint import State
from training.files import write_tensors
from training.network import ARCHITECTURES, TrainableR2D2
from visloc.errors import refuse
from visloc.features.networks.r2d2.model import pack

LICENCE = "BSD-3-Clause"
_LARGEST_HALF = 65504.0


def export(state: State, output: Path) -> int:
    """Write a checkpoint as weights for ``visloc.features``; return the number of bytes.

    Raises:
        InvalidInput: ``training.range`` if a weight does not fit 16 bits.
    """
    trained = TrainableR2D2(ARCHITECTURES[state.settings.architecture])
    trained.load_state_dict(state.network)
    network = trained.folded()
    for number, convolution in enumerate(network.convolutions()):
        largest = float(convolution.weight.abs().max())
        if not largest < _LARGEST_HALF:
            raise refuse(
                "training.range",
                field=f"convolutions.{number}",
                expected=f"less than {_LARGEST_HALF}",
                got=largest,
            )
    about = {
        "format": "visloc folded R2D2, version 1",
        "architecture": state.settings.architecture,
        "licence": LICENCE,
        "step": str(state.step),
        "seconds": f"{state.seconds:.0f}",
        "settings": dataclasses.asdict(state.settings),
        "torch": torch.__version__,
        **state.sources,
    }
    return write_tensors(output, pack(network), about)
