"""Reads the state dict in a file that PyTorch saved, without PyTorch and without running the file.

Since 1.6 that is a zip archive with the pickle ``<root>/data.pkl`` and the numbers of each storage
in ``<root>/data/<key>``; before that, five pickles in a row, then the numbers.

Python's unpickler makes nothing here but the classes and texts of ``_KNOWN``: what the names in the
file stand for. No file can change them. That does not stop a file from filling the memory or from
taking hours, so each pickle's opcodes are checked first: only names that a state dict needs, only
texts and short numbers as keys of dicts, and few bytes in all for texts that are used again.
"""

from __future__ import annotations

import _codecs
import io
import pickle
import pickletools
import struct
import zipfile
from collections.abc import Iterator, Mapping
from math import prod
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from visloc.features.weights import pickled_pca
from visloc.features.weights.pickled_pca import Pickled, PickledPca

# A state dict with the state of an optimizer has some 10,000, a long training log 150,000.
_MAX_OPCODES = 1_000_000
# Of texts fetched from the memo: each fetched one may become bytes of its own.
_MAX_FETCHED_BYTES = 64 * 2**20
_MAX_MEMBERS = 10_000  # of a zip archive
_MAX_INTEGER_BYTES = 8  # longer ones can be made to have equal hashes

# What pickle writes in protocol 2, as far as torch reads it. Others name things in ways that are
# not looked through here.
_OPCODES = frozenset(
    (
        *("PROTO", "STOP", "MARK", "GLOBAL", "REDUCE", "NEWOBJ", "BUILD", "BINPERSID"),
        *("EMPTY_DICT", "EMPTY_LIST", "EMPTY_TUPLE", "SETITEM", "SETITEMS"),
        *("APPEND", "APPENDS", "TUPLE", "TUPLE1", "TUPLE2", "TUPLE3", "NONE", "NEWTRUE"),
        *("NEWFALSE", "BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT", "BINUNICODE"),
        *("SHORT_BINSTRING", "BINPUT", "LONG_BINPUT", "BINGET", "LONG_BINGET"),
    )
)
_PUTS, _GETS = ("BINPUT", "LONG_BINPUT"), ("BINGET", "LONG_BINGET")
_OPCODES_OF_KEYS = frozenset(
    ("PROTO", "EMPTY_LIST", "MARK", "BINUNICODE", "APPEND", "APPENDS", "STOP", *_PUTS)
)

# Magic number 0x1950a86a20f9469cfc6c and protocol version 1001, each a pickle of its own.
_OLD_LAYOUT_START = b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19.\x80\x02M\xe9\x03."
# Where training programs keep the state dict, beside what they know about the training.
_STATE_DICT_KEYS = ("state_dict", "model_state")
_MAX_DIMENSIONS = 8

_MARK = object()

Numbers = Mapping[str, NDArray[Any]]
"""The numbers of each storage (n,), by its key."""


class _Dict(dict[Any, Any]):
    """Stands in for an ``OrderedDict``; torch puts a version of each module beside its items."""

    __slots__ = ()

    def __init__(self) -> None:  # of another dict it would be a copy, in a few bytes of the file
        super().__init__()

    def __setstate__(self, _: object) -> None:
        pass


class _DefaultDict(_Dict):
    """Stands in for a ``defaultdict``: the published Fast-R2D2 file has a training log of them."""

    __slots__ = ()

    def __init__(self, _default_factory: object = None) -> None:
        super().__init__()


class _Tensor(Pickled):
    """Stands in for a tensor: the arguments of ``_rebuild_tensor_v2``."""

    __slots__ = ()


_TYPES = {
    "torch.FloatStorage": "<f4",
    "torch.DoubleStorage": "<f8",
    "torch.HalfStorage": "<f2",
    "torch.LongStorage": "<i8",
}
# What each name makes. A pickle can set attributes of any object it can reach. So these are texts
# (the types of numbers), functions of C, and classes whose ``__setstate__`` keeps what is set.
_KNOWN: Mapping[str, Any] = {
    "torch._utils._rebuild_tensor_v2": _Tensor,
    **_TYPES,
    "collections.OrderedDict": _Dict,
    "collections.defaultdict": _DefaultDict,
    "builtins.list": Pickled,
    "__builtin__.list": Pickled,
    "_codecs.encode": _codecs.encode,  # how pickle protocol 2 writes bytes
    **pickled_pca.STAND_INS,
}


def read_torch_file(
    data: bytes, max_bytes: int
) -> tuple[dict[str, NDArray[Any]], dict[str, PickledPca]]:
    """Return the tensors of the state dict, read-only, and the PCAs of scikit-learn beside it.

    Args:
        data: the file.
        max_bytes: of all tensors; in the file, the numbers of one may stand for many.

    Raises:
        ValueError, TypeError and others that damaged files lead to; see ``checkpoint``.
    """
    content, numbers = _read_zip(data) if data[:2] == b"PK" else _read_old_layout(data)
    tensors = _state_dict(content, numbers)
    if sum(array.nbytes for array in tensors.values()) > max_bytes:
        raise ValueError(f"tensors of more than {max_bytes} bytes together")
    return tensors, _pca_of(content)


class _Unpickler(pickle.Unpickler):
    """Makes what ``_KNOWN`` says, of a pickle that ``_check_pickle`` has seen.

    Attributes:
        storages: type and count of the numbers in each storage that was named, by its key.
    """

    def __init__(self, data: bytes) -> None:
        super().__init__(io.BytesIO(data), encoding="utf-8")
        self.storages: dict[str, tuple[str, int]] = {}

    def find_class(self, module: str, name: str) -> Any:
        return _KNOWN[_checked_name(f"{module}.{name}")]

    def persistent_load(self, pid: Any) -> str:
        match pid:
            case ("storage", str(kind), str(key), str(), int(count), *view) if (
                kind in _TYPES.values()
                and view in ([], [None])  # torch has not written views for long
                and self.storages.setdefault(key, (kind, count)) == (kind, count)
            ):
                return key
        raise ValueError("a storage that is named as torch names none")


def _checked_name(name: str) -> str:
    if name not in _KNOWN:
        raise ValueError(f"{name} is no name that a state dict needs")
    return name


def _read_zip(data: bytes) -> tuple[object, Numbers]:
    if data.count(b"PK\x01\x02") > _MAX_MEMBERS:
        raise ValueError(f"an archive of more than {_MAX_MEMBERS} members")
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
        names = set(archive.namelist())
        pickles = [name for name in names if name.endswith("/data.pkl")]
        if len(pickles) != 1:
            raise ValueError("a zip archive, but not one of PyTorch")
        root = pickles[0].removesuffix("data.pkl")
        order = f"{root}byteorder"
        if order in names and archive.read(order) != b"little":
            raise ValueError("not written by a little-endian machine")
        pickled = archive.read(pickles[0])
        _check_pickle(pickled, 0)
        unpickler = _Unpickler(pickled)
        content = unpickler.load()
        return content, {
            key: _numbers(key, archive.read(member), kind, count)
            for key, (kind, count) in unpickler.storages.items()
            if (member := f"{root}data/{key}") in names
        }


def _read_old_layout(data: bytes) -> tuple[object, Numbers]:
    if not data.startswith(_OLD_LAYOUT_START):
        raise ValueError("neither a zip archive nor PyTorch's older layout")
    start = len(_OLD_LAYOUT_START)
    end = _check_pickle(data, start)
    if pickle.NEWFALSE in data[start:end]:
        raise ValueError("not written by a little-endian machine")
    end_of_content = _check_pickle(data, end)
    position = _check_pickle(data, end_of_content)
    unpickler = _Unpickler(data[end:end_of_content])
    content, numbers = unpickler.load(), dict[str, NDArray[Any]]()
    for key in _keys(data, end_of_content):
        if key not in unpickler.storages:
            raise ValueError(f"numbers of storage {key:.20}, which no tensor uses")
        kind, count = unpickler.storages[key]
        # torch reads the count as little-endian, whatever the file says.
        if struct.unpack_from("<q", data, position)[0] != count:
            raise ValueError(f"storage {key:.20} has another size than its tensors say")
        position += 8
        size = np.dtype(kind).itemsize * max(count, 0)
        numbers[key] = _numbers(key, data[position : position + size], kind, count)
        position += size
    return content, numbers


def _numbers(key: str, data: bytes, kind: str, count: int) -> NDArray[Any]:
    if len(data) != np.dtype(kind).itemsize * count:
        raise ValueError(f"storage {key:.20} has {len(data)} bytes for {count} numbers of {kind}")
    return np.frombuffer(data, kind)


def _keys(data: bytes, start: int) -> list[str]:
    """Return the texts in a pickled list."""
    found = [(opcode, text) for opcode, text, _ in _opcodes(data, start)]
    opcodes = [opcode for opcode, _ in found]
    if not _OPCODES_OF_KEYS.issuperset(opcodes) or opcodes.count("EMPTY_LIST") != 1:
        raise ValueError("something else than a list of storages")
    return [text for opcode, text in found if opcode == "BINUNICODE"]


def _check_pickle(data: bytes, start: int) -> int:
    """Refuse a pickle that no state dict needs; return where it ends."""
    end, encoding, keys = start, _Encoding(), _Keys()
    for opcode, argument, after in _opcodes(data, start):
        end = after
        encoding.check(opcode, argument)
        keys.check(opcode, argument)
        match opcode:
            case "GLOBAL":
                _checked_name(argument.replace(" ", "."))
            case "BINPUT" | "LONG_BINPUT" if argument >= _MAX_OPCODES:
                raise ValueError(f"memo entry {argument}")  # the unpickler makes room for all below
    return end


class _Keys:
    """Refuses dicts whose keys are not texts or numbers, and too many bytes of fetched texts.

    A key is hashed: of a tuple that holds the same tuples again and again, that takes forever, and
    of many keys with equal hashes the square of their number.
    """

    def __init__(self) -> None:
        # What the unpickler's stack holds: the bytes of a text, 0 for a number, None for anything
        # else, and _MARK.
        self._stack: list[int | object | None] = []
        self._memo: dict[int, int | object | None] = {}
        self._fetched_bytes = 0

    def check(self, opcode: str, argument: Any) -> None:
        """Take the next opcode of a pickle."""
        stack = self._stack
        match opcode:
            case "PROTO" | "STOP":
                pass
            case "MARK":
                stack.append(_MARK)
            case "BINUNICODE" | "SHORT_BINSTRING":
                stack.append(len(argument))
            case "BININT" | "BININT1" | "BININT2" | "LONG1":
                if argument.bit_length() >= 8 * _MAX_INTEGER_BYTES:
                    raise ValueError("a whole number of more than 8 bytes")
                stack.append(0)
            case "BINPUT" | "LONG_BINPUT":
                if stack[-1] is _MARK:
                    raise ValueError("a pickle that keeps what is not there")
                self._memo[argument] = stack[-1]
            case "BINGET" | "LONG_BINGET":
                stack.append(self._memo[argument])
                if isinstance(stack[-1], int):
                    self._fetched_bytes += stack[-1]
                if self._fetched_bytes > _MAX_FETCHED_BYTES:
                    raise ValueError("a pickle that uses the same texts again and again")
            case "TUPLE":
                self._above_mark()
                stack.append(None)
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                self._popped(int(opcode[-1]))
                stack.append(None)
            case "REDUCE" | "NEWOBJ":
                self._popped(2)
                stack.append(None)
            case "BINPERSID":
                self._popped(1)
                stack.append(None)
            case "APPEND" | "BUILD":
                self._popped(1)
            case "APPENDS":
                self._above_mark()
            case "SETITEM":
                self._check_keys(self._popped(2))
            case "SETITEMS":
                self._check_keys(self._above_mark())
            case _:  # GLOBAL, floats, truths, None, empty containers
                stack.append(None)

    def _popped(self, count: int) -> list[int | object | None]:
        if len(self._stack) < count or _MARK in self._stack[-count:]:
            raise ValueError("a pickle that takes more than there is")
        popped = self._stack[-count:]
        del self._stack[-count:]
        return popped

    def _above_mark(self) -> list[int | object | None]:
        above = []
        while (top := self._stack.pop()) is not _MARK:
            above.append(top)
        return above[::-1]

    @staticmethod
    def _check_keys(items: list[int | object | None]) -> None:
        if not all(isinstance(key, int) for key in items[::2]):
            raise ValueError("a dict whose keys are neither texts nor numbers")


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
        if opcode.name not in _OPCODES:
            raise ValueError(f"the opcode {opcode.name}, which no state dict needs")
        yield opcode.name, argument, stream.tell()


def _state_dict(content: object, numbers: Numbers) -> dict[str, NDArray[Any]]:
    if isinstance(content, dict):
        key = next((key for key in _STATE_DICT_KEYS if key in content), None)
        content = content if key is None else content[key]
    if not (isinstance(content, dict) and content):
        raise ValueError("no state dict")
    arrays = {}
    for name, value in content.items():
        if not (isinstance(name, str) and type(value) is _Tensor):
            raise TypeError(
                f"the state dict holds {type(value).__name__.lstrip('_')} under {name!r:.60}"
            )
        arrays[name] = _array(name, value, numbers)
    return arrays


def _array(name: str, tensor: _Tensor, numbers: Numbers) -> NDArray[Any]:
    match tensor.arguments:
        case (str(key), int(first), tuple(shape), tuple(strides), bool(), _, *other) if (
            other in ([], [None], [{}])  # else, such as a sign that is turned
            and len(shape) == len(strides) <= _MAX_DIMENSIONS
            and all(type(each) is int and each >= 0 for each in (first, *shape, *strides))
        ):
            pass
        case _:
            raise ValueError(f"tensor {name:.60} is described as torch describes none")
    if key not in numbers:
        raise ValueError(f"storage {key:.20} without numbers")
    found = numbers[key]
    last = first + sum((side - 1) * stride for side, stride in zip(shape, strides, strict=True))
    if prod(shape) and last >= len(found):
        raise ValueError(f"tensor {name:.60} reaches beyond its storage of {len(found)} numbers")
    item = found.itemsize
    return as_strided(found[first:], shape, [item * stride for stride in strides], writeable=False)


def _pca_of(content: object) -> dict[str, PickledPca]:
    found = content.get("pca") if type(content) is dict else None
    if type(found) is not dict:
        return {}
    return {
        name: pca
        for name, pca in found.items()
        if isinstance(name, str) and isinstance(pca, PickledPca)
    }
