"""From a checkpoint of training to the weights that are shipped."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from numpy.typing import NDArray
from torch import nn

from visloc.errors import refuse
from visloc.features.networks.r2d2 import model as r2d2
from visloc.features.networks.r2d2.architecture import ARCHITECTURES
from visloc.features.networks.r2d2.model import R2D2Network
from visloc.features.networks.xfeat import model as xfeat
from visloc.features.networks.xfeat.load import published_path
from visloc_extensions.training.checkpoint import State
from visloc_extensions.training.files import write_tensors

Arrays = Mapping[str, NDArray[Any]]

_LARGEST_HALF = 65504.0


def export(state: State, output: Path) -> int:
    """Write a checkpoint as weights for ``visloc.features``; return the number of bytes."""
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
    network = R2D2Network(ARCHITECTURES[state.settings.architecture])
    network.load_state_dict(state.network)
    network.double().fuse().float()
    _check_range(network)
    words = {"format": "visloc folded R2D2, version 1", "licence": "BSD-3-Clause"}
    return r2d2.pack(network), words


def _distilled(state: State) -> tuple[Arrays, dict[str, str]]:
    student, teacher_sha256 = xfeat.read_network(published_path(None))
    student.load_state_dict(state.network)
    _check_range(student)
    return xfeat.pack(student), {
        "format": "visloc fused XFeat, version 1",
        "licence": "Apache-2.0",
        "changed": "fine-tuned by visloc from the weights of XFeat (Potje et al. 2024)",
        "changed_from_sha256": teacher_sha256,
    }


def _check_range(network: nn.Module) -> None:
    for name, weight in network.state_dict().items():
        largest = float(weight.abs().max())
        if name.endswith("weight") and not largest < _LARGEST_HALF:
            raise refuse(
                "training.range", field=name, expected=f"less than {_LARGEST_HALF}", got=largest
            )
