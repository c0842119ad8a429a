"""The files of a map or a set, written with their checksums."""

from __future__ import annotations

import hashlib
import io
import itertools
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from visloc.archive.checks import SCALES, content_hash, json_text, manifest_hash, sha256_of

# Rows of an array that are converted and written at once.
BLOCK_ROWS = 8192
# Larger matrices of a model are stored in 8 bits.
_MAX_FLOAT_MODEL = 2**16


class Files:
    """Writes the files of a map and collects their checksums."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._written: dict[str, str] = {}

    def write_json(self, name: str, value: object) -> None:
        self.write_bytes(name, [json_text(value).encode()])

    def write_array(
        self,
        name: str,
        dtype: str,
        array: NDArray[Any],
        converted: Callable[[NDArray[Any]], NDArray[Any]] = np.asarray,
    ) -> None:
        """Write an array converted to ``dtype``, block by block."""
        self.write_blocks(name, dtype, array.shape, map(converted, blocks_of(array)))

    def write_blocks(
        self, name: str, dtype: str, shape: tuple[int, ...], blocks: Iterable[NDArray[Any]]
    ) -> None:
        """Write an ``.npy`` block by block.

        On a full disk ``np.save`` hides the reason, and a memory map ends the process.
        """
        header = io.BytesIO()
        np.lib.format.write_array_header_1_0(
            header, {"descr": dtype, "fortran_order": False, "shape": shape}
        )
        rows = (np.ascontiguousarray(block, dtype).data for block in blocks if block.size)
        self.write_bytes(name, itertools.chain([header.getvalue()], rows))

    def write_model(self, name: str, model: Mapping[str, NDArray[Any]]) -> None:
        """Write the arrays of a model, with large matrices in 8 bits."""
        path = self._path(name)
        with path.open("xb") as file:
            # The savez stub takes no mapping of arrays as keywords beside allow_pickle.
            np.savez(file, **_stored_model(model))  # type: ignore[arg-type]
        self._written[name] = sha256_of(path)

    def entries(self) -> dict[str, dict[str, int | str]]:
        """Size and checksum of all files in the folder, also of those that others wrote."""
        entries: dict[str, dict[str, int | str]] = {}
        for path in sorted(self.folder.rglob("*")):
            if path.is_file():
                name = path.relative_to(self.folder).as_posix()
                sha256 = self._written.get(name) or sha256_of(path)
                entries[name] = {"size": path.stat().st_size, "sha256": sha256}
        return entries

    def written(self) -> dict[str, dict[str, int | str]]:
        """Size and checksum of the files that this wrote."""
        return {
            name: {"size": (self.folder / name).stat().st_size, "sha256": sha256}
            for name, sha256 in self._written.items()
        }

    def finish(self, manifest: dict[str, Any], version: str) -> str:
        """Add version and hashes to a manifest, write it, and sync all files to disk.

        Returns:
            The version.
        """
        digest = content_hash(manifest)
        manifest["content_hash"] = digest
        manifest["version"] = version + digest[:8] if version.endswith("-") else version
        manifest["manifest_hash"] = manifest_hash(manifest)
        self.write_json("manifest.json", manifest)
        for path in self.folder.rglob("*"):
            if path.is_file():
                with path.open("rb") as file:
                    os.fsync(file.fileno())
        return str(manifest["version"])

    def write_bytes(self, name: str, parts: Iterable[bytes | memoryview]) -> None:
        digest = hashlib.sha256()
        with self._path(name).open("wb") as file:
            for part in parts:
                file.write(part)
                digest.update(part)
        self._written[name] = digest.hexdigest()

    def _path(self, name: str) -> Path:
        path = self.folder / name
        path.parent.mkdir(exist_ok=True)
        return path


def blocks_of(array: NDArray[Any]) -> Iterator[NDArray[Any]]:
    """Yield at most ``BLOCK_ROWS`` rows at a time."""
    for start in range(0, len(array), BLOCK_ROWS):
        yield array[start : start + BLOCK_ROWS]


def _stored_model(model: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """A model with its large matrices in 8 bits and a scale for each of their columns."""
    stored: dict[str, NDArray[Any]] = {}
    for name, array in model.items():
        if array.ndim != 2 or array.size <= _MAX_FLOAT_MODEL or array.dtype == np.int8:
            stored[name] = array
            continue
        largest = np.abs(array).max(axis=0)
        scales = np.where(largest > 0, largest, 1).astype(np.float32) / np.float32(127)
        stored[name] = np.rint(array / scales).astype(np.int8)
        stored[name + SCALES] = scales
    return stored
