"""From a checkpoint of training to the weights that are shipped."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from visloc.errors import refuse
from visloc.features.networks.r2d2 import model as r2d2
from visloc.features.networks.xfeat import model as xfeat
from visloc.features.networks.xfeat.torch import XFeatModule
from visloc_extensions.training.checkpoint import State
from visloc_extensions.training.files import write_tensors
from visloc_extensions.training.network import ARCHITECTURES, TrainableR2D2

Arrays = Mapping[str, NDArray[Any]]

_LARGEST_HALF = 65504.0


def export(state: State, output: Path) -> int:
    """Write a checkpoint as weights for ``visloc.features``; return the number of bytes.

    Raises:
        InvalidInput: ``training.range`` if a weight does not fit 16 bits.
    """
    architecture = state.settings.architecture
    arrays, words = _distilled(state) if architecture == "xfeat" else _from_scratch(state)
    about = {
        **words,
        "architecture": architecture,
        "step": str(state.step),
        "seconds": f"{state.seconds:.0f}",
        "settings": dataclasses.asdict(state.settings),
        "torch": torch.__version__,
        **state.sources,
    }
    return write_tensors(output, arrays, about)


def _from_scratch(state: State) -> tuple[Arrays, dict[str, str]]:
    trained = TrainableR2D2(ARCHITECTURES[state.settings.architecture])
    trained.load_state_dict(state.network)
    network = trained.folded()
    _check_range({f"convolutions.{n}": c.weight for n, c in enumerate(network.convolutions)})
    words = {"format": "visloc folded R2D2, version 1", "licence": "BSD-3-Clause"}
    return r2d2.pack(network), words


def _distilled(state: State) -> tuple[Arrays, dict[str, str]]:
    teacher, teacher_sha256 = xfeat.read_published(None)
    student = XFeatModule(teacher)
    student.load_state_dict(state.network)
    network = student.network()
    _check_range({name: each for name, each in network.arrays().items() if "weight" in name})
    return xfeat.pack(network), {
        "format": "visloc fused XFeat, version 1",
        "licence": "Apache-2.0",
        "changed": "fine-tuned by visloc from the weights of XFeat (Potje et al. 2024)",
        "changed_from_sha256": teacher_sha256,
    }


def _check_range(weights: Arrays) -> None:
    for name, weight in weights.items():
        largest = float(np.abs(weight).max())
        if not largest < _LARGEST_HALF:
            raise refuse(
                "training.range", field=name, expected=f"less than {_LARGEST_HALF}", got=largest
            )
