"""Reading a map's files without trusting them."""

from __future__ import annotations

import hashlib
import json
import math
import os
import stat
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError

from visloc.archive.npz import read_npy_header, read_npz
from visloc.archive.schema import FORMAT_MAJOR, FORMAT_MINOR, Manifest
from visloc.archive.set_schema import SET_FORMAT, SET_MAJOR, SET_MINOR, SetManifest
from visloc.errors import VislocError, refuse

RecordType = TypeVar("RecordType", bound=BaseModel)

_MAX_JSON_BYTES = 2**27  # about a million photos; parsed, it takes 20 times the memory
MAX_MANIFEST_BYTES = 16 * 2**20

# Rows of an array that are read at once: some hundred kilobytes.
_BLOCK_ROWS = 16_384

# Suffix of the array with the scales of the columns of a model's int8 matrix.
SCALES = ".scales"


def sha256_of(path: Path) -> str:
    """Checksum of a file as lower-case hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def content_hash(manifest: Mapping[str, Any]) -> str:
    """Hash of everything in a map except its id, version and creation time.

    Args:
        manifest: the manifest as JSON values; its ``files`` carry the other files' checksums.
    """
    return _hash_without(manifest, "id", "version", "created", "content_hash", "manifest_hash")


def manifest_hash(manifest: Mapping[str, Any]) -> str:
    """Hash of the whole manifest except the hash itself."""
    return _hash_without(manifest, "manifest_hash")


def json_text(value: object) -> str:
    """The canonical form of a map's JSON files."""
    return json.dumps(value, indent=1, sort_keys=True, allow_nan=False) + "\n"


def _hash_without(manifest: Mapping[str, Any], *left_out: str) -> str:
    fields = {key: value for key, value in manifest.items() if key not in left_out}
    return hashlib.sha256(json_text(fields).encode()).hexdigest()


def read_manifest(folder: Path) -> Manifest:
    """Read ``manifest.json`` of a map folder."""
    manifest = read_any_manifest(folder)
    if isinstance(manifest, SetManifest):
        raise is_set(f"{manifest.id}@{manifest.version}", manifest)
    return manifest


def read_any_manifest(folder: Path) -> Manifest | SetManifest:
    """Read ``manifest.json`` of the folder of a map or a set."""
    path = folder / "manifest.json"
    return parse_any_manifest(_read_bytes(path, MAX_MANIFEST_BYTES, "map.manifest"), str(path))


def parse_any_manifest(content: bytes, address: str) -> Manifest | SetManifest:
    """Parse ``manifest.json`` of a map or a set."""
    if len(content) > MAX_MANIFEST_BYTES:
        raise _too_large(address, MAX_MANIFEST_BYTES, "map.manifest")
    text = _decoded(content, address, "map.manifest")
    try:
        fields = json.loads(text)
        of_set, version = fields.get("format") == SET_FORMAT, str(fields.get("format_version", ""))
    except (ValueError, AttributeError, RecursionError):
        of_set, version = False, ""
    newest = (SET_MAJOR, SET_MINOR) if of_set else (FORMAT_MAJOR, FORMAT_MINOR)
    major = version.partition(".")[0]
    if major.isascii() and major.isdigit() and len(major) < 9 and int(major) > newest[0]:
        raise refuse(
            "map.format_version",
            field=address,
            expected=f"format {newest[0]}.x or older (this program writes {newest[0]}.{newest[1]})",
            got=version,
        )
    if of_set:
        return _parse(SetManifest, text, address, "map.manifest")
    return _parse(Manifest, text, address, "map.manifest")


def is_set(ref: str, manifest: SetManifest) -> VislocError:
    """``map.is_set``."""
    some = ", ".join(tile.ref for tile in manifest.tiles[:3])
    return refuse("map.is_set", field="map", expected=f"a map, such as {some}", got=ref)


def check_files(folder: Path, manifest: Manifest | SetManifest) -> None:
    """Check that every file of the manifest exists and has its size."""
    for name, entry in manifest.files.items():
        parts = PurePosixPath(name).parts
        if not parts or ".." in parts or name.startswith("/") or "\\" in name or "\0" in name:
            raise refuse("map.file_name", field=str(folder / "manifest.json"), got=name)
        path = folder / name
        try:
            status = path.lstat()
        except (OSError, ValueError):  # ValueError: lone surrogates
            status = None
        if status is None or not stat.S_ISREG(status.st_mode):
            raise refuse("map.file_missing", field=str(path))
        size = status.st_size
        if size != entry.size:
            raise refuse(
                "map.file_size",
                field=str(path),
                expected=f"{entry.size} bytes",
                got=f"{size} bytes",
            )


def check_checksums(folder: Path, manifest: Manifest | SetManifest) -> None:
    """Read every byte of a map and compare it with the manifest."""
    for name, entry in manifest.files.items():
        digest = sha256_of(folder / name)
        if digest != entry.sha256:
            raise refuse(
                "map.checksum",
                field=str(folder / name),
                expected=f"sha256 {entry.sha256}",
                got=digest,
            )
    path = folder / "manifest.json"
    text = path.read_text(encoding="utf-8")
    fields = json.loads(text)
    if (
        text != json_text(fields)
        or manifest_hash(fields) != manifest.manifest_hash
        or content_hash(fields) != manifest.content_hash
    ):
        raise refuse("map.manifest_hash", field=str(path))


def read_record(folder: Path, name: str, record: type[RecordType]) -> RecordType:
    """Read one of a map's JSON files."""
    path = folder / name
    text = _decoded(_read_bytes(path, _MAX_JSON_BYTES, "map.json"), str(path), "map.json")
    return _parse(record, text, str(path), "map.json")


def map_array(
    folder: Path,
    name: str,
    dtype: str,
    shape: tuple[int, ...],
    *,
    before: str | None = None,
    load: bool = False,
) -> NDArray[Any]:
    """Open one ``.npy`` of a map, memory-mapped and read-only unless ``load``.

    Args:
        dtype: the type that it must have.
        shape: the shape that it must have.
        before: the type that older formats had, if another.
    """
    path = folder / name
    found, offset, order = _array_header(path, dtype, shape, before)
    if load or 0 in shape:  # nothing cannot be mapped into memory
        try:
            values = np.fromfile(path, found, math.prod(shape), offset=offset)
        except OSError as error:
            raise _cut_short(path) from error
        if len(values) < math.prod(shape):
            raise _cut_short(path)
        return values.reshape(shape, order=order)
    return np.memmap(path, found, "r", offset, shape, order)


def array_rows(
    folder: Path, name: str, dtype: str, shape: tuple[int, ...], rows: NDArray[np.integer]
) -> NDArray[Any]:
    """Read some rows of one ``.npy`` of a map, without mapping it into memory.

    If a mapped file is truncated, reading it ends the process (SIGBUS); reading a file that was
    truncated raises an error. Only blocks of the file that hold wanted rows are read.

    Args:
        dtype: the type that it must have.
        shape: the shape that it must have.
        rows: (k,) in any order.
    """
    path = folder / name
    found, offset, order = _array_header(path, dtype, shape, None)
    if order == "F" and len(shape) > 1:  # a row is not in one place
        whole: NDArray[Any] = map_array(folder, name, dtype, shape, load=True)[rows]
        return whole
    width = math.prod(shape[1:])
    by_place = np.argsort(rows)
    ordered = rows[by_place].astype(np.int64)
    chosen = np.empty((len(rows), *shape[1:]), found)
    try:
        with path.open("rb") as file:
            for block in np.unique(ordered // _BLOCK_ROWS):
                start = int(block) * _BLOCK_ROWS
                stop = min(start + _BLOCK_ROWS, shape[0])
                file.seek(offset + start * width * found.itemsize)
                data = file.read((stop - start) * width * found.itemsize)
                if len(data) < (stop - start) * width * found.itemsize:
                    raise _cut_short(path)
                first, last = np.searchsorted(ordered, (start, stop))
                values = np.frombuffer(data, found).reshape(-1, *shape[1:])
                chosen[by_place[first:last]] = values[ordered[first:last] - start]
    except OSError as error:
        raise _cut_short(path) from error
    return chosen


def read_model(folder: Path, name: str) -> dict[str, NDArray[np.float32]]:
    """Read the arrays of a global descriptor's model (``.npz`` without compression)."""
    path = folder / name
    try:
        model = read_npz(path)
    except (ValueError, OSError) as error:
        raise refuse(
            "map.array",
            "the file does not hold a model",
            field=str(path),
            expected="an .npz without compression",
            got=str(error),
        ) from error
    for key in [key for key in model if key + SCALES in model and not key.endswith(SCALES)]:
        model[key] = _widened(model[key], model.pop(key + SCALES))
    for key, array in model.items():
        if array.dtype != np.float32 or not np.isfinite(array).all():
            raise refuse(
                "map.array",
                f"array {key!r} of a model is not valid",
                field=str(path),
                expected="finite float32, or int8 with finite float32 scales of its columns",
                got=str(array.dtype),
            )
    return model


def _widened(values: NDArray[Any], scales: NDArray[Any]) -> NDArray[Any]:
    """Multiply the columns of an int8 matrix by their scales; return any other array as it is."""
    fits = values.ndim == 2 and scales.shape == values.shape[1:]
    if not fits or values.dtype != np.int8 or scales.dtype != np.float32:
        return values
    with np.errstate(over="ignore", invalid="ignore"):  # the caller refuses infinities
        return np.asarray(values * scales)


def _array_header(
    path: Path, dtype: str, shape: tuple[int, ...], before: str | None
) -> tuple[np.dtype[Any], int, Literal["C", "F"]]:
    """Check an ``.npy``; return its type, the offset of its numbers, and their order."""
    try:
        with path.open("rb") as file:
            found_shape, fortran, found = read_npy_header(file)
            offset = file.tell()
            size = file.seek(0, os.SEEK_END)
    except (ValueError, OSError) as error:
        raise refuse("map.array", "the file is not a NumPy array", field=str(path)) from error
    expected = np.dtype(dtype if before is None or found != np.dtype(before) else before)
    whole = size == offset + math.prod(shape) * expected.itemsize
    # Before memory is allocated, as a header can claim any shape.
    if found != expected or found_shape != shape or not whole:
        raise refuse(
            "map.array",
            "an array of the map does not match the manifest; restore or rebuild the map",
            field=str(path),
            expected=f"{expected} of shape {shape}, in a file as long as that",
            got=f"{found} of shape {found_shape}, in {size} bytes",
        )
    return expected, offset, "F" if fortran else "C"


def _cut_short(path: Path) -> VislocError:
    return refuse(
        "map.array", "an array of the map is cut short; restore or rebuild the map", field=str(path)
    )


def _read_bytes(path: Path, limit: int, code: str) -> bytes:
    try:
        status = path.lstat()
        if not stat.S_ISREG(status.st_mode):  # opening a pipe waits for its other end
            raise refuse(code, "this is not a plain file", field=str(path), expected="a plain file")
        if status.st_size > limit:
            raise _too_large(str(path), limit, code)
        return path.read_bytes()
    except FileNotFoundError:
        raise refuse(code, "the file is missing", field=str(path)) from None
    except OSError as error:
        raise refuse(
            code, "the file cannot be read", field=str(path), got=error.strerror
        ) from error


def _too_large(address: str, limit: int, code: str) -> VislocError:
    return refuse(code, "the file is too large", field=address, expected=f"at most {limit} bytes")


def _decoded(content: bytes, address: str, code: str) -> str:
    try:
        return content.decode()
    except UnicodeDecodeError as error:
        raise refuse(code, "the file is not UTF-8 text", field=address) from error


def _parse(record: type[RecordType], text: str, address: str, code: str) -> RecordType:
    try:
        return record.model_validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        raise refuse(
            code, f"{where or 'the file'}: {first['msg']}", field=address, got=first["input"]
        ) from error


def is_finite(array: NDArray[Any], block: int = 1_000_000) -> bool:
    """Tell whether all numbers are finite, block by block."""
    return all(
        bool(np.isfinite(array[start : start + block]).all())
        for start in range(0, max(len(array), 1), block)
    )
