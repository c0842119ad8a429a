"""Reads the tensors of a weights file without running anything that the file says.

The library safetensors reads files of that name, ``torch.load(weights_only=True)`` those of
PyTorch: since 1.6 a zip archive with the pickle ``<root>/data.pkl``, before that five pickles in a
row, then the numbers.

torch refuses to run code, but not to fill the memory: it knows ``bytearray``, and a file of some
kilobytes can have a text of a megabyte encoded a hundred thousand times. So the opcodes of each
pickle are looked through first: only names that a state dict needs, and no more work than a small
multiple of the file.
"""

from __future__ import annotations

import hashlib
import io
import pickle
import pickletools
import struct
import threading
import zipfile
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load as load_safetensors

from visloc.errors import refuse
from visloc.features.weights import pickled_pca
from visloc.features.weights.pickled_pca import Pickled, PickledPca

MAX_FILE_BYTES = 256 * 2**20
_SAFETENSORS_LENGTH_BYTES = 8  # of the number that says how long the header is
# The library allows ten times as much, enough to name millions of empty tensors.
_MAX_SAFETENSORS_HEADER_BYTES = 10_000_000
_DTYPES = frozenset(map(np.dtype, ("<f4", "<f8", "<f2", "<i8")))

# A state dict with the state of an optimizer has some 10,000, a long training log 150,000.
_MAX_OPCODES = 1_000_000
_MAX_TUPLES = 10_000  # bounds how deep tuples can nest: hashing one recurses in C
_SHORT_TEXT = 100
# An object fetched from the memo may be as large as all of the pickle before it. Together those
# fetched may have this many bytes, and so many more for each byte of the pickle.
_MAX_FETCHED_BYTES, _MAX_FETCHED_SHARE = 64 * 2**20, 32

_PUTS, _GETS = ("BINPUT", "LONG_BINPUT"), ("BINGET", "LONG_BINGET")
_OPCODES_OF_KEYS = frozenset(
    ("PROTO", "EMPTY_LIST", "MARK", "BINUNICODE", "APPEND", "APPENDS", "STOP", *_PUTS)
)

# Magic number 0x1950a86a20f9469cfc6c and protocol version 1001, each a pickle of its own.
_OLD_LAYOUT_START = b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19.\x80\x02M\xe9\x03."
# Where training programs keep the state dict, beside what they know about the training.
_STATE_DICT_KEYS = ("state_dict", "model_state")
_NAMES_OF_TORCH = frozenset(
    (
        "collections.OrderedDict",
        "torch._utils._rebuild_tensor_v2",
        "torch.FloatStorage",
        "torch.DoubleStorage",
        "torch.HalfStorage",
        "torch.LongStorage",
        "_codecs.encode",  # how pickle protocol 2 writes bytes
    )
)


def _dict_for_defaultdict(_default_factory: object) -> dict[Any, Any]:
    return {}


# The published Fast-R2D2 file holds a training log of defaultdict(list).
_STAND_INS: Mapping[str, Any] = {
    "collections.defaultdict": _dict_for_defaultdict,
    "builtins.list": Pickled,
    **pickled_pca.STAND_INS,
}
_NAMES = _NAMES_OF_TORCH | _STAND_INS.keys() | {"__builtin__.list"}
_TORCH_LOAD = threading.Lock()  # the names that torch knows are those of the whole process

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
        max_bytes: how large it may be.
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
        content = _read_torch(data)
        return Checkpoint(path, found_sha256, _state_dict(content), _pca_of(content))
    except _MALFORMED as error:
        raise refuse(
            "weights.format", field=str(path), got=f"{type(error).__name__}: {_reason(error)}"
        ) from error


def _reason(error: BaseException) -> str:
    """Return the error's own words, without torch's advice to trust the file and run it."""
    text = str(error)
    return text.rpartition("WeightsUnpickler error:")[2].strip().partition("\n")[0] or text


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


def _read_torch(data: bytes) -> object:
    if data[:2] == b"PK":
        _check_zip(data)
    else:
        _check_old_layout(data)
    import torch  # takes a second, which safetensors need not

    stand_ins: list[Any] = [(stand_in, name) for name, stand_in in _STAND_INS.items()]
    with _TORCH_LOAD, torch.serialization.safe_globals(stand_ins):
        return torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)


def _check_zip(data: bytes) -> None:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = archive.infolist()
        # torch.save never compresses; members that unpack to more than the file are an attack.
        if any(member.compress_type != zipfile.ZIP_STORED for member in members):
            raise ValueError("compressed members")
        if sum(member.file_size for member in members) > len(data):
            raise ValueError("members that overlap or are cut off")
        # torch takes the first of a name, Python the last.
        if len({member.filename.lower() for member in members}) < len(members):
            raise ValueError("several members of one name")
        pickles = [name for name in archive.namelist() if name.endswith("/data.pkl")]
        if len(pickles) != 1:
            raise ValueError("a zip archive, but not one of PyTorch")
        _check_pickle(archive.read(pickles[0]), 0)


def _check_old_layout(data: bytes) -> None:
    if not data.startswith(_OLD_LAYOUT_START):
        raise ValueError("neither a zip archive nor PyTorch's older layout")
    start = len(_OLD_LAYOUT_START)
    end = _check_pickle(data, start)
    # torch reads the numbers as little-endian, whatever the file says.
    if pickle.NEWFALSE in data[start:end]:
        raise ValueError("not written by a little-endian machine")
    keys = _check_pickle(data, end)
    _check_pickle(data, keys)
    # torch hands out a storage without numbers as it found the memory.
    if not _storages(data, end) <= _keys(data, keys):
        raise ValueError("a storage without numbers")


def _storages(data: bytes, start: int) -> set[str]:
    """The keys of the storages that a pickle of the older layout uses."""
    found, texts = set[str](), dict[int, Any]()
    pushed: deque[tuple[str, Any]] = deque(maxlen=5)
    for opcode, argument, _ in _opcodes(data, start):
        if opcode in _PUTS:
            texts[argument] = pushed[-1][1] if pushed else None
            continue
        if opcode == "BINPERSID":
            match list(pushed):
                case [
                    (_, str(key)),
                    (_, str()),
                    ("BININT" | "BININT1" | "BININT2" | "LONG1", _),
                    ("NONE", _),
                    ("TUPLE", _),
                ]:
                    found.add(key)
                case _:
                    raise ValueError("a storage that is named as torch names none")
        text = argument if opcode == "BINUNICODE" else None
        pushed.append((opcode, texts.get(argument) if opcode in _GETS else text))
    return found


def _keys(data: bytes, start: int) -> set[str]:
    """The texts in a pickled list."""
    found = [(opcode, text) for opcode, text, _ in _opcodes(data, start)]
    if not {opcode for opcode, _ in found} <= _OPCODES_OF_KEYS:
        raise ValueError("something else than a list of storages")
    return {text for opcode, text in found if opcode == "BINUNICODE"}


def _check_pickle(data: bytes, start: int) -> int:
    """Refuse a pickle that no state dict needs; return where it ends."""
    end = start
    cheap: set[int] = set()  # memo entries of names and short texts, which everything fetches
    fetched_bytes = num_tuples = 0
    last_is_cheap = False
    encoding = _Encoding()
    for opcode, argument, end in _opcodes(data, start):
        encoding.check(opcode, argument)
        match opcode:
            case "GLOBAL" if (name := argument.replace(" ", ".")) not in _NAMES:
                raise ValueError(f"{name} is no name that a state dict needs")
            case "BINPUT" | "LONG_BINPUT":
                (cheap.add if last_is_cheap else cheap.discard)(argument)
            case "BINGET" | "LONG_BINGET" if argument not in cheap:
                fetched_bytes += end - start
            case "TUPLE" | "TUPLE1" | "TUPLE2" | "TUPLE3":
                num_tuples += 1
        last_is_cheap = opcode == "GLOBAL" or (
            opcode == "BINUNICODE" and len(argument) <= _SHORT_TEXT
        )
    if num_tuples > _MAX_TUPLES:
        raise ValueError(f"{num_tuples} tuples")
    if fetched_bytes > _MAX_FETCHED_BYTES + _MAX_FETCHED_SHARE * (end - start):
        raise ValueError("a pickle that uses the same objects again and again")
    return end


class _Encoding:
    """Refuses ``_codecs.encode`` unless it makes bytes of a text, as pickle does.

    torch calls it with any codec: hexadecimal digits of hexadecimal digits, and so on, make a
    terabyte of thirty calls.
    """

    def __init__(self) -> None:
        self._functions, self._latin1 = set[int](), set[int]()  # memo entries
        self._pushed: list[str] = []  # from the function on
        self._last = ""

    def check(self, opcode: str, argument: Any) -> None:
        """Take the next opcode of a pickle."""
        if opcode in _PUTS:
            for kind, entries in (("function", self._functions), ("latin1", self._latin1)):
                (entries.add if self._last == kind else entries.discard)(argument)
            return
        self._last = self._kind(opcode, argument)
        if self._pushed or self._last == "function":
            self._pushed.append(self._last)
        match self._pushed:
            case [] | ["function"] | ["function", "text" | "latin1"]:
                pass
            case ["function", "text" | "latin1", "latin1"]:
                pass
            case ["function", _, "latin1", "TUPLE2"]:
                pass
            case ["function", _, _, _, "REDUCE"]:
                self._pushed.clear()
            case _:
                raise ValueError("_codecs.encode, but not for bytes as pickle writes them")

    def _kind(self, opcode: str, argument: Any) -> str:
        if opcode in _GETS and argument in self._functions:
            return "function"
        if opcode == "GLOBAL":
            return "function" if argument == "_codecs encode" else opcode
        if argument == "latin1" or (opcode in _GETS and argument in self._latin1):
            return "latin1"
        return "text" if opcode == "BINUNICODE" or opcode in _GETS else opcode


def _opcodes(data: bytes, start: int) -> Iterator[tuple[str, Any, int]]:
    """Yield name, argument and end of each opcode of a pickle."""
    stream = io.BytesIO(data)
    stream.seek(start)
    for count, (opcode, argument, _) in enumerate(pickletools.genops(stream)):
        if count >= _MAX_OPCODES:
            raise ValueError(f"a pickle of more than {_MAX_OPCODES} opcodes")
        if count == 0 and (opcode.name, argument) != ("PROTO", 2):
            raise ValueError("not a pickle of protocol 2")
        yield opcode.name, argument, stream.tell()


def _state_dict(content: object) -> dict[str, NDArray[Any]]:
    import torch

    if isinstance(content, dict):
        key = next((key for key in _STATE_DICT_KEYS if key in content), None)
        content = content if key is None else content[key]
    if not (isinstance(content, dict) and content):
        raise ValueError("no state dict")
    arrays = {}
    # Copied before it is checked: a file can replace methods of an OrderedDict.
    for name, value in dict(content).items():
        if not (isinstance(name, str) and type(value) is torch.Tensor):
            raise TypeError(f"the state dict holds {type(value).__name__} under {name!r:.60}")
        array = arrays[name] = value.detach().numpy()
        array.flags.writeable = False
    return arrays


def _pca_of(content: object) -> dict[str, PickledPca]:
    found = content.get("pca") if type(content) is dict else None
    if type(found) is not dict:
        return {}
    return {
        name: pca
        for name, pca in found.items()
        if isinstance(name, str) and isinstance(pca, PickledPca)
    }
