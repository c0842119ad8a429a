"""Everything a training run needs to go on as if it had never stopped."""

from __future__ import annotations

import dataclasses
import io
import pickle
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from visloc.errors import NotFound, refuse
from visloc_extensions.training.files import write_whole
from visloc_extensions.training.settings import Settings

FILE_NAME = "checkpoint.pt"
_VERSION = 3


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """A training run between two steps.

    There is no state of random numbers: those of a step come from the seed and its number.

    Attributes:
        seconds: how long that took, on all machines together.
        sources: words for the model card: sha256 of the photos, their licences, and so on.
        network: state dict of ``TrainableR2D2``, or of ``XFeat``.
    """

    settings: Settings
    step: int
    seconds: float
    sources: dict[str, str]
    network: dict[str, Any]
    optimizer: dict[str, Any]


def save_state(path: Path, state: State) -> None:
    """Write a checkpoint; a crash leaves the old one or the new one."""
    content = {
        "version": _VERSION,
        "settings": dataclasses.asdict(state.settings),
        "step": state.step,
        "seconds": state.seconds,
        "sources": state.sources,
        "network": state.network,
        "optimizer": state.optimizer,
    }
    buffer = io.BytesIO()
    torch.save(content, buffer)
    write_whole(path, buffer.getvalue())


def load_state(path: Path, device: torch.device) -> State:
    """Read a checkpoint; nothing in it is run."""
    if not path.is_file():
        raise refuse("training.checkpoint", field=str(path), kind=NotFound)
    try:
        content = torch.load(path, map_location=device, weights_only=True)
        _check_version(content["version"])
        return State(
            Settings(**content["settings"]),
            content["step"],
            content["seconds"],
            content["sources"],
            content["network"],
            content["optimizer"],
        )
    except (
        RuntimeError,
        pickle.UnpicklingError,
        EOFError,
        LookupError,
        TypeError,
        ValueError,
    ) as e:
        raise refuse(
            "training.checkpoint",
            "this is not a checkpoint of this training code",
            field=str(path),
            expected=f"version {_VERSION}",
            got=f"{type(e).__name__}: {e}",
        ) from e


def _check_version(version: object) -> None:
    if version != _VERSION:
        raise ValueError(f"version {version}")
