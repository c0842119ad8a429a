"""Reads the tensors of a weights file without running anything that the file says.

A safetensors file says nothing that could be run; the library of that name reads it. PyTorch saves
a pickle that describes tensors, beside the raw numbers, in one of two layouts:

- since 1.6 a zip archive: ``<root>/data.pkl`` and one member ``<root>/data/<key>`` per storage;
- before, three pickles in a row (byte order and type sizes, the object, the storage keys), then
  each storage as its int64 length and its numbers.

Why not ``torch.load(weights_only=True)``: it refuses the published Fast-R2D2 file, whose training
log is made of ``defaultdict``, and the AP-GeM files, which hold an object of scikit-learn. The
unpickler below knows the four names that a state dict needs (OrderedDict, defaultdict, list,
torch's _rebuild_tensor_v2), the names of storage types and those of ``pickled_pca``, and puts
harmless stand-ins in their place. Before it runs, the opcodes are compared with those that such
files need, so that no declared size or index can allocate more than a small multiple of the file;
and there may be at most a million, because a byte of a pickle can make an object of a hundred.
"""

from __future__ import annotations

import hashlib
import io
import pickle
import pickletools
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load

from visloc.errors import refuse
from visloc.features.weights.pickled_pca import PickledPca, stand_in

MAX_FILE_BYTES = 256 * 2**20
_SAFETENSORS_LENGTH_BYTES = 8  # of the number that says how long the header is
# The library allows ten times as much, enough to name millions of empty tensors.
_MAX_SAFETENSORS_HEADER_BYTES = 10_000_000
# A state dict with the state of an optimizer has some 10,000, a long training log 150,000.
_MAX_OPCODES = 1_000_000
_MAX_TUPLES = 10_000  # bounds how deep tuples can nest: hashing one recurses in C
_MAX_DIMENSIONS = 8

# Magic number 0x1950a86a20f9469cfc6c and protocol version 1001, each a pickle of its own.
_OLD_LAYOUT_START = b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19.\x80\x02M\xe9\x03."
_OPCODES = frozenset(
    (
        *("PROTO", "STOP", "MARK", "GLOBAL", "REDUCE", "NEWOBJ", "BUILD", "BINPERSID"),
        *("NONE", "NEWTRUE", "NEWFALSE", "BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT"),
        *("BINUNICODE", "EMPTY_TUPLE", "TUPLE", "TUPLE1", "TUPLE2", "TUPLE3"),
        *("EMPTY_LIST", "APPEND", "APPENDS", "EMPTY_DICT", "SETITEM", "SETITEMS"),
        *("BINPUT", "LONG_BINPUT", "BINGET", "LONG_BINGET"),
    )
)
# Where training programs keep the state dict, beside what they know about the training.
_STATE_DICT_KEYS = ("state_dict", "model_state")
_STORAGE_DTYPES: Mapping[str, np.dtype[Any]] = {
    "FloatStorage": np.dtype("<f4"),
    "DoubleStorage": np.dtype("<f8"),
    "HalfStorage": np.dtype("<f2"),
    "LongStorage": np.dtype("<i8"),
}
# What damaged files raise, according to the documentation of ``pickle`` and trial.
_MALFORMED = (
    SafetensorError,
    pickle.UnpicklingError,
    zipfile.BadZipFile,
    ArithmeticError,
    AttributeError,
    EOFError,
    LookupError,
    RuntimeError,
    TypeError,
    ValueError,
)


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint:
    """What a weights file holds.

    Attributes:
        path: where it was read from.
        sha256: of the file, lower-case hexadecimal.
        tensors: arrays by their names in the state dict; read-only.
        pca: what the file holds under ``pca`` beside the state dict, for
            ``pickled_pca.principal_components``; empty without.
    """

    path: Path
    sha256: str
    tensors: Mapping[str, NDArray[Any]]
    pca: Mapping[str, PickledPca] = field(default_factory=dict)


class _Storage(NamedTuple):
    key: str
    dtype_name: str
    num_values: int


class _Tensor(NamedTuple):
    storage: _Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


def read_checkpoint(path: Path, max_bytes: int = MAX_FILE_BYTES) -> Checkpoint:
    """Read a safetensors file, or a state dict that PyTorch saved.

    That may be bare or under the key ``state_dict`` or ``model_state`` of a dict. Whatever else
    the dict holds (the state of an optimizer, options, scores) is not looked at, except for
    scikit-learn's PCAs by name under ``pca``.

    Args:
        path: the file.
        max_bytes: how large it may be.

    Raises:
        WeightsError: ``weights.unreadable`` when the file cannot be read, ``weights.too_large``
            when it exceeds ``max_bytes``, ``weights.format`` when it is neither safetensors nor a
            PyTorch file of plain tensors, is damaged, or names anything that a state dict does
            not need.
    """
    try:
        with path.open("rb") as file:
            data = file.read(max_bytes + 1)
    except OSError as error:
        raise refuse("weights.unreadable", field=str(path), got=error.strerror) from error
    if len(data) > max_bytes:
        raise refuse("weights.too_large", field=str(path), expected=f"at most {max_bytes} bytes")
    try:
        content, tensors = _read(data)
    except _MALFORMED as error:
        raise refuse(
            "weights.format", field=str(path), got=f"{type(error).__name__}: {error}"
        ) from error
    return Checkpoint(path, hashlib.sha256(data).hexdigest(), tensors, _pca_of(content))


def _pca_of(content: object) -> dict[str, PickledPca]:
    found = content.get("pca") if type(content) is dict else None
    if type(found) is not dict:
        return {}
    return {
        name: pca
        for name, pca in found.items()
        if isinstance(name, str) and isinstance(pca, PickledPca)
    }


def _read(data: bytes) -> tuple[object, Mapping[str, NDArray[Any]]]:
    if data[:2] == b"PK":
        return _read_zip(data)
    if data[_SAFETENSORS_LENGTH_BYTES : _SAFETENSORS_LENGTH_BYTES + 1] == b"{":
        return None, _read_safetensors(data)
    return _read_old_layout(data)


def _read_safetensors(data: bytes) -> dict[str, NDArray[Any]]:
    header_bytes = int.from_bytes(data[:_SAFETENSORS_LENGTH_BYTES], "little")
    if header_bytes > _MAX_SAFETENSORS_HEADER_BYTES:
        raise ValueError(f"a header of {header_bytes} bytes")
    try:
        tensors = load(data)
    except KeyError as error:  # a type that NumPy has not, such as BF16
        raise ValueError(f"a tensor of type {error.args[0]}") from error
    for name, array in tensors.items():
        if array.dtype not in _STORAGE_DTYPES.values():
            raise ValueError(f"tensor {name:.60} is of type {array.dtype}")
        array.flags.writeable = False
    return tensors


def _read_old_layout(data: bytes) -> tuple[object, dict[str, NDArray[Any]]]:
    if not data.startswith(_OLD_LAYOUT_START):
        raise ValueError("neither a zip archive nor PyTorch's older layout")
    system, position, _ = _unpickle(data, len(_OLD_LAYOUT_START))
    if not (isinstance(system, dict) and system.get("little_endian") is True):
        raise ValueError("not written by a little-endian machine")
    content, position, storages = _unpickle(data, position)
    keys, position, _ = _unpickle(data, position)
    references = _tensor_references(content)
    starts: dict[str, int] = {}
    for key in keys:
        storage = storages[key]
        if int.from_bytes(data[position : position + 8], "little") != storage.num_values:
            raise ValueError(f"storage {key} is not as long as its tensors need")
        starts[key] = position + 8
        position += 8 + storage.num_values * _STORAGE_DTYPES[storage.dtype_name].itemsize

    def storage_bytes(storage: _Storage) -> memoryview:
        return memoryview(data)[starts[storage.key] :]

    tensors = {name: _view(reference, storage_bytes) for name, reference in references.items()}
    return content, tensors


def _read_zip(data: bytes) -> tuple[object, dict[str, NDArray[Any]]]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = archive.infolist()
        # torch.save never compresses; members that unpack to more than the file are an attack.
        if any(member.compress_type != zipfile.ZIP_STORED for member in members):
            raise ValueError("compressed members")
        if sum(member.file_size for member in members) > len(data):
            raise ValueError("members that overlap or are cut off")
        names = [member.filename for member in members]
        roots = [name.removesuffix("data.pkl") for name in names if name.endswith("/data.pkl")]
        if len(roots) != 1:
            raise ValueError("a zip archive, but not one of PyTorch")
        byte_order = f"{roots[0]}byteorder"
        if byte_order in names and archive.read(byte_order) != b"little":
            raise ValueError("not written by a little-endian machine")

        @cache  # tensors may share a storage
        def storage_bytes(storage: _Storage) -> memoryview:
            return memoryview(archive.read(f"{roots[0]}data/{storage.key}"))

        content, _, _ = _unpickle(archive.read(f"{roots[0]}data.pkl"), 0)
        references = _tensor_references(content)
        tensors = {name: _view(reference, storage_bytes) for name, reference in references.items()}
        return content, tensors


def _tensor_references(content: object) -> dict[str, _Tensor]:
    if isinstance(content, dict):
        key = next((key for key in _STATE_DICT_KEYS if key in content), None)
        content = content if key is None else content[key]
    if not (isinstance(content, dict) and content):
        raise ValueError("no state dict")
    references = dict(content)  # before the check: a file can replace methods of an OrderedDict
    for name, value in references.items():
        if not (isinstance(name, str) and isinstance(value, _Tensor)):
            raise TypeError(f"the state dict holds {type(value).__name__} under {name!r:.60}")
    return references


def _view(tensor: _Tensor, storage_bytes: Callable[[_Storage], memoryview]) -> NDArray[Any]:
    """Return the tensor as a read-only view of its storage, after checking every bound."""
    storage, offset, shape, strides = tensor
    dtype = _STORAGE_DTYPES[storage.dtype_name]
    last = offset + sum((n - 1) * step for n, step in zip(shape, strides, strict=True))
    if last >= storage.num_values or 0 in shape:
        raise ValueError(f"a tensor of shape {shape} does not fit its storage")
    values = np.frombuffer(storage_bytes(storage), dtype, count=storage.num_values)
    return np.lib.stride_tricks.as_strided(
        values[offset:], shape, [step * dtype.itemsize for step in strides], writeable=False
    )


def _unpickle(data: bytes, start: int) -> tuple[Any, int, dict[str, _Storage]]:
    """Return the object pickled at ``start``, the position after it, and the storages it names."""
    end = _end_of_harmless_pickle(data, start)
    unpickler = _Unpickler(io.BytesIO(data[start:end]))
    return unpickler.load(), end, unpickler.storages


def _end_of_harmless_pickle(data: bytes, start: int) -> int:
    stream = io.BytesIO(data)
    stream.seek(start)
    num_tuples = 0
    for count, (opcode, argument, _) in enumerate(pickletools.genops(stream)):
        if count >= _MAX_OPCODES:
            raise ValueError(f"a pickle of more than {_MAX_OPCODES} opcodes")
        if opcode.name not in _OPCODES:
            raise ValueError(f"pickle opcode {opcode.name}, which a state dict does not need")
        # The C unpickler allocates its memo up to the index asked for.
        if opcode.name == "LONG_BINPUT" and isinstance(argument, int) and argument > count:
            raise ValueError("memo index out of order")
        num_tuples += opcode.name.startswith("TUPLE")
    if num_tuples > _MAX_TUPLES:
        raise ValueError(f"{num_tuples} tuples")
    return stream.tell()


class _Unpickler(pickle.Unpickler):
    """Knows the names below and no other; nothing is imported.

    What it returns for them are stand-ins that can only make an empty dict or take a note, and
    that are new each time or cannot be changed: a file can neither call anything else nor leave
    anything behind in them.
    """

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file)
        self.storages: dict[str, _Storage] = {}

    def find_class(self, module: str, name: str) -> Any:
        match module, name:
            case "collections", "OrderedDict":
                return lambda: OrderedDict()
            case "collections", "defaultdict":
                return lambda _default_factory: {}
            case (("__builtin__" | "builtins"), "list"):
                return name  # only ever the default factory of a defaultdict
            case "torch._utils", "_rebuild_tensor_v2":
                return lambda *arguments: _note_tensor(*arguments)
            case "torch", _ if name in _STORAGE_DTYPES:
                return name
        known = stand_in(module, name)
        if known is not None:
            return known
        raise pickle.UnpicklingError(f"{module}.{name} is no name that a state dict needs")

    def persistent_load(self, pid: Any) -> _Storage:
        kind, dtype_name, key, _device, num_values, *view = pid
        if not (
            kind == "storage"
            and dtype_name in _STORAGE_DTYPES
            and isinstance(key, str)
            and _is_count(num_values)
            and all(part is None for part in view)
        ):
            raise pickle.UnpicklingError("a reference to something that is no storage")
        storage = _Storage(key, dtype_name, num_values)
        if self.storages.setdefault(key, storage) != storage:
            raise pickle.UnpicklingError("one storage with two descriptions")
        return storage


def _note_tensor(storage: Any, offset: Any, shape: Any, strides: Any, *_autograd: Any) -> _Tensor:
    if not (
        isinstance(storage, _Storage)
        and len(shape) == len(strides) <= _MAX_DIMENSIONS
        and all(_is_count(number) for number in (offset, *shape, *strides))
    ):
        raise pickle.UnpicklingError("a tensor with an odd description")
    return _Tensor(storage, offset, tuple(shape), tuple(strides))


def _is_count(value: object) -> bool:
    return type(value) is int and 0 <= value < 2**40
