"""Resumable work: every result is a file named by the hash of all its inputs.

A stage asks for an item by its key. If the file exists, it is read; otherwise the work is done and
the file appears by one atomic rename. A build that was killed finds its finished items again. A
build whose photos, settings, weights or code changed does not find the items that depend on them.

Files are not synced to disk: that took longer than making most of them. A power loss may leave
damaged items; their checksums show it, and they are made again.
"""

from __future__ import annotations

import fcntl
import hashlib
import io
import json
import os
import platform
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapping.cluster.stage_timings import wrote
from mapping.cluster.storage import is_remote, remove_folder
from visloc.archive.npz import read_npz
from visloc.errors import refuse

# Marks a folder of finished work, which may be removed.
_MARKER = "visloc-work.txt"
_MARKER_TEXT = b"Finished work of a build. It is removed when the map is published.\n"
# NumPy's letters for the arrays of items: numbers, booleans, text.
_KINDS = "biufU"

Item = Mapping[str, NDArray[Any]]


def key_of(stage: str, revision: int, **inputs: object) -> str:
    """Return the name of a result, from the stage, the revision of its code, and all inputs.

    Args:
        stage: also the folder of its items.
        revision: raised whenever the code changes the result.
        inputs: JSON values: settings, and keys of the items that the stage reads.
    """
    text = json.dumps([stage, revision, inputs], sort_keys=True)
    return f"{stage}/{hashlib.sha256(text.encode()).hexdigest()[:32]}"


@dataclass(frozen=True, slots=True)
class WorkFolder:
    """Finished items of a build, found again after an interruption.

    Attributes:
        root: a folder, or a URL of object storage, where files appear whole.
    """

    root: Path

    @property
    def scratch(self) -> Path:
        """A folder of this machine for temporary files."""
        return Path(tempfile.gettempdir()) if is_remote(self.root) else self.root

    def claim(self) -> None:
        """Mark the folder as finished work, so that it may be removed."""
        marker = self.root / _MARKER
        if marker.is_file():
            return
        if self.root.exists() and any(self.root.iterdir()):
            raise refuse(
                "build.work_dir",
                field="--work-dir",
                expected=f"a folder that is not there yet, or is empty, or has {_MARKER}",
                got=str(self.root),
            )
        if not is_remote(self.root):
            self.root.mkdir(parents=True, exist_ok=True)
        marker.write_bytes(_MARKER_TEXT)

    def remove(self) -> None:
        if is_remote(self.root):
            remove_folder(self.root)
        else:
            shutil.rmtree(self.root, ignore_errors=True)

    def has(self, key: str) -> bool:
        return self._path(key).is_file()

    def read(self, key: str) -> Item:
        """Read a finished item."""
        try:
            return self._load(key)
        except FileNotFoundError as error:
            raise refuse("build.missing_item", field=str(self._path(key))) from error
        except ValueError as error:
            self._path(key).unlink(missing_ok=True)
            raise refuse("build.damaged_item", field=str(self._path(key))) from error

    def get(self, key: str, compute: Callable[[], Item]) -> Item:
        """Read an item, or compute and keep it."""
        try:
            return self._load(key)
        except (FileNotFoundError, ValueError):
            item = compute()
        path = self._path(key)
        if is_remote(path):
            buffer = io.BytesIO()
            np.savez(buffer, **item)  # type: ignore[arg-type]  # the stub knows no **arrays
            wrote(path.write_bytes(buffer.getvalue()))
            return item
        path.parent.mkdir(parents=True, exist_ok=True)
        # Machines may share the folder.
        unfinished = path.with_suffix(f".{platform.node()}.{os.getpid()}.tmp")
        with unfinished.open("wb") as file:
            np.savez(file, **item)  # type: ignore[arg-type]  # the stub knows no **arrays
            wrote(file.tell())
        unfinished.replace(path)
        return item

    def _load(self, key: str) -> Item:
        path = self._path(key)
        arrays = read_npz(path.read_bytes() if is_remote(path) else path, _KINDS)
        # Copies are writable, like computed arrays.
        return {name: array.copy() for name, array in arrays.items()}

    def _path(self, key: str) -> Path:
        return self.root / f"{key}.npz"


@contextmanager
def exclusive(lock: Path) -> Iterator[None]:
    """Hold a lock file against a second build; it is released when the process ends.

    The file stays, since two builds could hold locks of the same name if it were removed.
    """
    lock.parent.mkdir(parents=True, exist_ok=True)
    with lock.open("a") as file:  # an existing file keeps its content
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise refuse("build.running", field=str(lock)) from None
        yield
