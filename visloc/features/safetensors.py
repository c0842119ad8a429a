"""Reads and writes safetensors files: named arrays and a few words about them, nothing to run.

Layout: the header's length as an unsigned 64-bit little-endian number, the header in JSON, then
the numbers. The header names each tensor with its type, shape and span of bytes; ``__metadata__``
holds words by name.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

_DTYPES: Mapping[str, np.dtype[Any]] = {
    "F64": np.dtype("<f8"),
    "F32": np.dtype("<f4"),
    "F16": np.dtype("<f2"),
    "I64": np.dtype("<i8"),
    "U8": np.dtype("u1"),
}
_NAMES = {dtype: name for name, dtype in _DTYPES.items()}
_MAX_HEADER_BYTES = 10_000_000
_MAX_DIMENSIONS = 8
_LENGTH_BYTES = 8


@dataclass(frozen=True, slots=True, eq=False)
class Tensors:
    """What a file holds.

    Attributes:
        arrays: by name; views of the file's bytes, read-only.
        metadata: words by name.
    """

    arrays: Mapping[str, NDArray[Any]]
    metadata: Mapping[str, str]


def is_safetensors(data: bytes) -> bool:
    """Tell whether bytes begin as such a file does: a length, then a JSON object."""
    return data[_LENGTH_BYTES : _LENGTH_BYTES + 1] == b"{"


def decode_tensors(data: bytes) -> Tensors:
    """Read the bytes of a safetensors file.

    Raises:
        ValueError: with what is wrong, if it is damaged or none.
    """
    length = int.from_bytes(data[:_LENGTH_BYTES], "little")
    start = _LENGTH_BYTES + length
    if len(data) < _LENGTH_BYTES or length > _MAX_HEADER_BYTES or start > len(data):
        raise ValueError("no header of safetensors")
    text = data[_LENGTH_BYTES:start]
    try:
        header = json.loads(text) if text.startswith(b"{") else None
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise ValueError("its header is no JSON") from error
    if header is None:
        raise ValueError("its header is no JSON object")
    metadata = header.pop("__metadata__", {})
    if not (isinstance(metadata, dict) and all(isinstance(v, str) for v in metadata.values())):
        raise ValueError("its metadata are not words by name")
    values = memoryview(data)[start:]
    return Tensors({name: _array(name, said, values) for name, said in header.items()}, metadata)


def _array(name: str, said: object, values: memoryview) -> NDArray[Any]:
    said = said if isinstance(said, dict) else {}
    dtype = _DTYPES.get(str(said.get("dtype")))
    if dtype is None:
        raise ValueError(f"tensor {name:.60}: not one of the types {', '.join(_DTYPES)}")
    shape, span = (_counts(said.get(key)) for key in ("shape", "data_offsets"))
    if len(shape) > _MAX_DIMENSIONS:
        raise ValueError(f"tensor {name:.60}: more than {_MAX_DIMENSIONS} dimensions")
    if len(span) != 2 or not span[0] <= span[1] <= len(values):
        raise ValueError(f"tensor {name:.60}: its span is not inside the file")
    if span[1] - span[0] != math.prod(shape) * dtype.itemsize:
        raise ValueError(f"tensor {name:.60}: its span does not fit its shape")
    return np.frombuffer(values[span[0] : span[1]], dtype).reshape(shape)


def _counts(numbers: object) -> list[int]:
    if isinstance(numbers, list) and all(type(n) is int and 0 <= n < 2**40 for n in numbers):
        return numbers
    raise ValueError("a shape or span that is no list of counts")


def encode_tensors(
    arrays: Mapping[str, NDArray[Any]], metadata: Mapping[str, str] | None = None
) -> bytes:
    """Return the bytes of a safetensors file; equal content gives equal bytes."""
    header: dict[str, Any] = {"__metadata__": dict(sorted((metadata or {}).items()))}
    parts, position = [], 0
    # Wide types first, so that every tensor begins at a multiple of its item size.
    for name in sorted(arrays, key=lambda each: (-arrays[each].dtype.itemsize, each)):
        array = np.ascontiguousarray(arrays[name])
        part = array.tobytes()
        span = [position, position + len(part)]
        header[name] = {
            "dtype": _NAMES[array.dtype],
            "shape": list(array.shape),
            "data_offsets": span,
        }
        parts.append(part)
        position = span[1]
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    return b"".join([len(text).to_bytes(_LENGTH_BYTES, "little"), text, *parts])
