"""Reads the tensors of a weights file without running anything that the file says.

The library safetensors reads files of that name. torch reads those that it saved, and makes nothing
but tensors and plain values of them (``weights_only``).
"""

from __future__ import annotations

import hashlib
import io
import pickle
import struct
import threading
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load as load_safetensors

from visloc.errors import refuse

MAX_FILE_BYTES = 256 * 2**20
_SAFETENSORS_LENGTH_BYTES = 8  # of the number that says how long the header is
# The library allows ten times as much, enough to name millions of empty tensors.
_MAX_SAFETENSORS_HEADER_BYTES = 10_000_000
_DTYPES = frozenset(map(np.dtype, ("<f4", "<f8", "<f2", "<i8")))
# Where training programs keep the state dict, beside what they know about the training.
_STATE_DICT_KEYS = ("state_dict", "model_state")

# The names that torch takes are the whole process's: one thread would take them from another.
_SAFE_NAMES_LOCK = threading.Lock()

# Damaged files raise these, according to the documentation of ``pickle`` and to experiments.
_MALFORMED = (
    SafetensorError,
    pickle.UnpicklingError,
    struct.error,
    ArithmeticError,
    AssertionError,
    AttributeError,
    EOFError,
    LookupError,
    MemoryError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
)


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint:
    """Tensors of a weights file.

    Attributes:
        sha256: of the file, lower-case hexadecimal.
        tensors: arrays by their names in the state dict; not to be written to.
        beside: what the file holds beside the state dict.
    """

    path: Path
    sha256: str
    tensors: Mapping[str, NDArray[Any]]
    beside: Mapping[str, Any] = field(default_factory=dict)

    def renamed(self, name_of: Callable[[str], str]) -> Checkpoint:
        """Return it with other names of the tensors."""
        return replace(self, tensors={name_of(name): a for name, a in self.tensors.items()})


def sha256_of(path: Path, max_bytes: int = MAX_FILE_BYTES) -> str:
    """Return the sha256 of a weights file, whose content is not looked at.

    Raises:
        WeightsError: ``weights.unreadable`` or ``weights.too_large``.
    """
    return hashlib.sha256(_content(path, max_bytes)).hexdigest()


def read_checkpoint(
    path: Path, max_bytes: int = MAX_FILE_BYTES, *, sha256: str | None = None
) -> Checkpoint:
    """Read a safetensors file, or a state dict that PyTorch saved, which loads torch.

    The state dict may be bare or under the key ``state_dict`` or ``model_state`` of a dict.

    Args:
        max_bytes: how large it may be.
        sha256: of the only file that will do; checked before anything is read out of it.
    """
    data = _content(path, max_bytes)
    found_sha256 = hashlib.sha256(data).hexdigest()
    if sha256 not in (None, found_sha256):
        raise refuse(
            "weights.altered", field=str(path), expected=f"sha256 {sha256}", got=found_sha256
        )
    try:
        if data[_SAFETENSORS_LENGTH_BYTES : _SAFETENSORS_LENGTH_BYTES + 1] == b"{":
            return Checkpoint(path, found_sha256, _read_safetensors(data))
        return Checkpoint(path, found_sha256, *_read_torch_file(data))
    except _MALFORMED as error:
        # Around what is wrong, torch says how to switch its checks off.
        is_torchs = isinstance(error, pickle.UnpicklingError) and error.__context__ is not None
        reason = str(error.__context__ if is_torchs else error).partition(" Please use ")[0]
        raise refuse(
            "weights.format", field=str(path), got=f"{type(error).__name__}: {reason}"
        ) from error


def _content(path: Path, max_bytes: int) -> bytes:
    try:
        with path.open("rb") as file:
            data = file.read(max_bytes + 1)
    except OSError as error:
        raise refuse("weights.unreadable", field=str(path), got=error.strerror) from error
    if len(data) > max_bytes:
        raise refuse("weights.too_large", field=str(path), expected=f"at most {max_bytes} bytes")
    return data


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


def _read_torch_file(data: bytes) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Return the tensors of the state dict, and what is beside it."""
    import torch

    with (
        _SAFE_NAMES_LOCK,
        torch.serialization.safe_globals(_beside_tensors()),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore", UserWarning)  # of pickles that torch then refuses
        content = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    beside: dict[str, Any] = {}
    if isinstance(content, dict):
        key = next((key for key in _STATE_DICT_KEYS if key in content), None)
        if key is not None:
            beside = {name: value for name, value in content.items() if name != key}
            content = content[key]
    if not (isinstance(content, dict) and content):
        raise ValueError("no state dict")
    tensors: dict[str, NDArray[Any]] = {}
    for name, value in content.items():
        if not (isinstance(name, str) and isinstance(value, torch.Tensor)):
            raise TypeError(f"the state dict holds {type(value).__name__} under {name!r:.60}")
        tensors[name] = value.detach().numpy()
        if tensors[name].dtype not in _DTYPES:
            raise ValueError(f"tensor {name:.60} is of type {tensors[name].dtype}")
    return tensors, beside


def _beside_tensors() -> list[Any]:
    """Return what else published files name: numbers of NumPy, and dicts with a default."""
    reconstruct, scalar = np.empty(0).__reduce__()[0], np.float32(0).__reduce__()[0]
    types = [type(np.dtype(kind)) for kind in ("f4", "f8", "i8")]
    functions = [
        (function, f"numpy.{core}.multiarray.{name}")
        for core in ("core", "_core")
        for function, name in ((reconstruct, "_reconstruct"), (scalar, "scalar"))
    ]
    return [
        np.ndarray,
        np.dtype,
        *types,
        *functions,
        (list, "builtins.list"),
        (_empty_dict, "collections.defaultdict"),
    ]


def _empty_dict(*_default_factory: object) -> dict[Any, Any]:
    return {}
