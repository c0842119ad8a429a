"""Reading NumPy's ``.npz`` archives without trusting them."""

from __future__ import annotations

import errno
import io
import math
import tokenize
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

_SUFFIX = ".npy"
_ENCRYPTED = 0x1  # bit of a zip entry's flags
_EMPTY_BYTES = 22  # a zip archive of nothing


def read_npz(archive: Path | bytes, kinds: str = "biuf") -> dict[str, NDArray[Any]]:
    """Read the arrays of an uncompressed archive; they are read-only.

    Compressed entries, and arrays whose shape does not fit their entry, are refused before they
    are read. So memory never exceeds the size of the file, whatever its headers claim.

    Args:
        kinds: NumPy's letters of the allowed types; by default numbers and booleans.
    """
    source = io.BytesIO(archive) if isinstance(archive, bytes) else archive
    size = len(archive) if isinstance(archive, bytes) else archive.stat().st_size
    with zip_errors(), zipfile.ZipFile(source) as opened:
        entries = opened.infolist()
        _check_entries(entries, size)
        arrays = {}
        for entry in entries:
            with opened.open(entry) as file:
                arrays[entry.filename.removesuffix(_SUFFIX)] = _read_array(file, entry, kinds)
        return arrays


@contextmanager
def zip_errors() -> Iterator[None]:
    """Turn the errors of ``zipfile`` for an archive that is damaged into ValueErrors."""
    try:
        yield
    except (zipfile.BadZipFile, NotImplementedError, EOFError, OverflowError) as error:
        raise ValueError(str(error) or "the archive is cut short") from error
    except OSError as error:
        if error.errno != errno.EINVAL:
            raise
        raise ValueError("an entry is said to be where no file can have one") from error


def _check_entries(entries: list[zipfile.ZipInfo], size: int) -> None:
    for entry in entries:
        if (
            entry.compress_type != zipfile.ZIP_STORED
            or entry.flag_bits & _ENCRYPTED
            or entry.file_size != entry.compress_size
        ):
            raise ValueError(f"{entry.filename!r} is compressed or encrypted")
        if entry.comment:  # a damaged length of it hides the entries that follow
            raise ValueError(f"{entry.filename!r} has a comment")
        if not entry.filename.endswith(_SUFFIX):
            raise ValueError(f"{entry.filename!r} is not an array")
    if not entries and size > _EMPTY_BYTES:
        raise ValueError("the archive lists nothing of what it holds")
    if len({entry.filename for entry in entries}) != len(entries):
        raise ValueError("an array occurs twice")
    if sum(entry.file_size for entry in entries) > size:  # entries could share bytes
        raise ValueError("the arrays are larger than the archive")


def read_npy_header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Read the header of an ``.npy``; its numbers follow in the file.

    Returns:
        Shape, whether the order is Fortran's, and type. They are not checked.
    """
    try:
        version = np.lib.format.read_magic(file)
        read_header = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }[version]
        return read_header(file)
    # The header is a Python literal; evaluating it can raise all of these.
    except (
        ValueError,
        KeyError,
        TypeError,
        SyntaxError,
        MemoryError,
        RecursionError,
        tokenize.TokenError,
    ) as error:
        raise ValueError("not an array") from error


def _read_array(file: IO[bytes], entry: zipfile.ZipInfo, kinds: str) -> NDArray[Any]:
    try:
        shape, fortran, dtype = read_npy_header(file)
    except ValueError as error:
        raise ValueError(f"{entry.filename!r} is not an array") from error
    num_bytes = entry.file_size - file.tell()
    if (
        dtype.kind not in kinds
        or any(length < 0 for length in shape)
        or math.prod(shape) * dtype.itemsize != num_bytes
    ):
        raise ValueError(
            f"{entry.filename!r} is said to be {dtype} of shape {shape}, in {num_bytes} bytes"
        )
    data = file.read(num_bytes + 1)  # to the end, where its checksum is compared
    if len(data) != num_bytes:
        raise ValueError(f"{entry.filename!r} is cut short")
    return np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C")
