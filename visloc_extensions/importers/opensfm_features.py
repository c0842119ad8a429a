"""OpenSfM's feature files: NumPy archives, read without trusting their headers."""

from __future__ import annotations

import os
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapping.importers.reading.json_fields import LARGEST
from visloc.errors import VislocError, refuse

_MAX_FEATURES = 1_000_000
_MAX_DIMENSIONS = 4096
_MAX_BYTES = 2**30


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """The features of one photo.

    Attributes:
        path: the file.
        points: (n, 4) float32: x, y, size (normalized) and angle in degrees.
        descriptors: (n, D) uint8 or float32.
        unread: the names of other arrays.
    """

    path: Path
    points: NDArray[np.float32]
    descriptors: NDArray[Any]
    unread: tuple[str, ...]


def read_features(folder: Path, names: Sequence[str]) -> list[Features] | None:
    """Read the features of photos, None unless all have a file."""
    paths = []
    for name in names:
        files = [Path(f"{folder / name}.{ending}") for ending in ("features.npz", "npz")]
        found = [file for file in files if os.path.isfile(file)]  # noqa: PTH113 - is_file raises
        if not found:
            return None
        paths.append(found[0])
    features: list[Features] = []
    for path in paths:
        made = _read(path)
        kind = (made.descriptors.shape[1], made.descriptors.dtype)
        first = features[0] if features else made
        if kind != (first.descriptors.shape[1], first.descriptors.dtype):
            raise _error(
                path,
                "the descriptors differ in kind from those of the other photos",
                f"{first.descriptors.dtype} of length {first.descriptors.shape[1]}",
                f"{kind[1]} of length {kind[0]}",
            )
        features.append(made)
    return features


def _read(path: Path) -> Features:
    try:
        with zipfile.ZipFile(path) as archive:
            points = _array(path, archive, "points")
            descriptors = _array(path, archive, "descriptors")
            unread = tuple(sorted(set(archive.namelist()) - {"points.npy", "descriptors.npy"}))
    except (OSError, zipfile.BadZipFile, zlib.error, EOFError, RuntimeError) as error:
        raise _error(path, "the archive cannot be read", None, str(error)) from error
    if points.shape[1] != 4 or points.dtype.kind != "f" or not _is_sane(points):
        raise _error(path, "the points are not valid", "(n, 4) finite floats", _kind(points))
    if len(descriptors) != len(points):
        raise _error(
            path,
            "the numbers of descriptors and points differ",
            str(len(points)),
            str(len(descriptors)),
        )
    if descriptors.dtype == np.uint8:
        return Features(path, points.astype(np.float32), descriptors, unread)
    if descriptors.dtype.kind != "f" or not _is_sane(descriptors):
        raise _error(
            path, "the descriptors are not valid", "bytes or finite floats", _kind(descriptors)
        )
    return Features(path, points.astype(np.float32), descriptors.astype(np.float32), unread)


def _array(path: Path, archive: zipfile.ZipFile, name: str) -> NDArray[Any]:
    """Read one two-dimensional array. What its header announces is checked before it is read."""
    try:
        info = archive.getinfo(f"{name}.npy")
    except KeyError:
        raise _error(path, f"{name!r} is missing", "points and descriptors", None) from None
    with archive.open(info) as file:
        try:
            version = np.lib.format.read_magic(file)
            read_header = {
                (1, 0): np.lib.format.read_array_header_1_0,
                (2, 0): np.lib.format.read_array_header_2_0,
            }[version]
            shape, fortran, dtype = read_header(file)
        except (ValueError, KeyError) as error:
            raise _error(path, f"{name!r} is not an array", None, str(error)) from error
        if (
            dtype.kind not in "fu"
            or dtype.itemsize > 8
            or fortran
            or len(shape) != 2
            or not 0 <= shape[0] <= _MAX_FEATURES
            or not 1 <= shape[1] <= _MAX_DIMENSIONS
        ):
            raise _error(
                path,
                f"{name!r} is not valid",
                f"numbers, up to {_MAX_FEATURES} rows of up to {_MAX_DIMENSIONS}",
                f"{dtype} {shape}",
            )
        size = shape[0] * shape[1] * dtype.itemsize
        if size > _MAX_BYTES:
            raise _error(path, f"{name!r} is too large", f"{_MAX_BYTES} bytes", str(size))
        data = file.read(size + 1)
    if len(data) != size:
        raise _error(
            path, f"{name!r} does not have the length that it announces", f"{size} bytes", None
        )
    return np.frombuffer(data, dtype).reshape(shape)


def _is_sane(array: NDArray[Any]) -> bool:
    return bool(np.abs(array).max(initial=0.0) <= LARGEST)  # NaN is not


def _kind(array: NDArray[Any]) -> str:
    return f"{array.dtype} {array.shape}"


def _error(path: Path, message: str, expected: str | None, got: str | None) -> VislocError:
    return refuse("import.features", message, field=str(path), expected=expected, got=got)
