"""Reads the tensors of a weights file without running anything that the file says.

The library safetensors reads files of that name, ``torch_file`` those of PyTorch.
"""

from __future__ import annotations

import hashlib
import pickle
import struct
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load as load_safetensors

from visloc.errors import refuse
from visloc.features.weights.pickled_pca import PickledPca
from visloc.features.weights.torch_file import read_torch_file

MAX_FILE_BYTES = 256 * 2**20
_SAFETENSORS_LENGTH_BYTES = 8  # of the number that says how long the header is
# The library allows ten times as much, enough to name millions of empty tensors.
_MAX_SAFETENSORS_HEADER_BYTES = 10_000_000
_DTYPES = frozenset(map(np.dtype, ("<f4", "<f8", "<f2", "<i8")))

# Damaged files raise these, according to the documentation of ``pickle`` and to experiments.
_MALFORMED = (
    SafetensorError,
    pickle.UnpicklingError,
    struct.error,
    zipfile.BadZipFile,
    ArithmeticError,
    AssertionError,
    AttributeError,
    EOFError,
    LookupError,
    MemoryError,
    RuntimeError,
    TypeError,
    ValueError,
)


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint:
    """Tensors of a weights file.

    Attributes:
        path: where it was read from.
        sha256: of the file, lower-case hexadecimal.
        tensors: arrays by their names in the state dict; read-only.
        pca: the PCAs of scikit-learn that the file holds under ``pca`` beside the state dict.
    """

    path: Path
    sha256: str
    tensors: Mapping[str, NDArray[Any]]
    pca: Mapping[str, PickledPca] = field(default_factory=dict)

    def renamed(self, name_of: Callable[[str], str]) -> Checkpoint:
        """Return it with other names of the tensors."""
        return replace(self, tensors={name_of(name): a for name, a in self.tensors.items()})


def read_checkpoint(
    path: Path, max_bytes: int = MAX_FILE_BYTES, *, sha256: str | None = None
) -> Checkpoint:
    """Read a safetensors file, or a state dict that PyTorch saved.

    The state dict may be bare or under the key ``state_dict`` or ``model_state`` of a dict. The
    rest of that dict (the state of an optimizer, options, scores) is ignored, except for PCAs of
    scikit-learn under ``pca``.

    Args:
        path: the file.
        max_bytes: how large it may be, and the tensors of a state dict together.
        sha256: of the only file that will do; checked before anything is read out of it.

    Raises:
        WeightsError: ``weights.unreadable`` when the file cannot be read, ``weights.too_large``
            when it exceeds ``max_bytes``, ``weights.altered`` when its sha256 is another,
            ``weights.format`` when it is neither safetensors nor a PyTorch file of plain tensors,
            is damaged, or names anything that a state dict does not need.
    """
    try:
        with path.open("rb") as file:
            data = file.read(max_bytes + 1)
    except OSError as error:
        raise refuse("weights.unreadable", field=str(path), got=error.strerror) from error
    if len(data) > max_bytes:
        raise refuse("weights.too_large", field=str(path), expected=f"at most {max_bytes} bytes")
    found_sha256 = hashlib.sha256(data).hexdigest()
    if sha256 not in (None, found_sha256):
        raise refuse(
            "weights.altered", field=str(path), expected=f"sha256 {sha256}", got=found_sha256
        )
    try:
        if data[_SAFETENSORS_LENGTH_BYTES : _SAFETENSORS_LENGTH_BYTES + 1] == b"{":
            return Checkpoint(path, found_sha256, _read_safetensors(data))
        return Checkpoint(path, found_sha256, *read_torch_file(data, max_bytes))
    except _MALFORMED as error:
        raise refuse(
            "weights.format", field=str(path), got=f"{type(error).__name__}: {error}"
        ) from error


def _read_safetensors(data: bytes) -> dict[str, NDArray[Any]]:
    header_bytes = int.from_bytes(data[:_SAFETENSORS_LENGTH_BYTES], "little")
    if header_bytes > _MAX_SAFETENSORS_HEADER_BYTES:
        raise ValueError(f"a header of {header_bytes} bytes")
    try:
        tensors = load_safetensors(data)
    except KeyError as error:  # a type that NumPy has not, such as BF16
        raise ValueError(f"a tensor of type {error.args[0]}") from error
    for name, array in tensors.items():
        if array.dtype not in _DTYPES:
            raise ValueError(f"tensor {name:.60} is of type {array.dtype}")
        array.flags.writeable = False
    return tensors
