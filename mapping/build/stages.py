"""Resumable work: every result is a file named by the hash of all that it depends on.

A stage asks for an item by its key. If the file is there it is read, otherwise the work is done
and the file appears by one atomic rename. A build that was killed finds its finished items again;
a build whose photos, settings, weights or code changed finds none of those that depend on them.

Nobody waits until an item is on the disk: that took longer than making most of them. A machine that
loses power may leave damaged ones; their checksums tell, and they are made again.
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

# Tells that a folder is one of finished work, which may be removed.
_MARKER = "visloc-work.txt"
_MARKER_TEXT = b"Finished work of a build. It is removed when the map is published.\n"
# NumPy's letters of what items hold: numbers, truth values, text.
_KINDS = "biufU"

Item = Mapping[str, NDArray[Any]]


def key_of(stage: str, revision: int, **inputs: object) -> str:
    """Name of a result: the stage, the revision of its code, and all that goes in.

    Args:
        stage: name of the stage; the folder of its items.
        revision: raised whenever the code changes what comes out.
        inputs: JSON values: settings, and the keys of the items that it reads.
    """
    text = json.dumps([stage, revision, inputs], sort_keys=True)
    return f"{stage}/{hashlib.sha256(text.encode()).hexdigest()[:32]}"


@dataclass(frozen=True, slots=True)
class WorkFolder:
    """Finished items of a build, found again after an interruption.

    Attributes:
        root: a folder, or a URL of object storage, where what is written appears whole.
    """

    root: Path

    @property
    def scratch(self) -> Path:
        """A folder of this machine for temporary files."""
        return Path(tempfile.gettempdir()) if is_remote(self.root) else self.root

    def claim(self) -> None:
        """Mark the folder as one of finished work, so that it may be removed.

        Raises:
            InvalidInput: ``build.work_dir`` for a folder of somebody else's files.
        """
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
        """Remove the folder with all that is in it."""
        if is_remote(self.root):
            remove_folder(self.root)
        else:
            shutil.rmtree(self.root, ignore_errors=True)

    def has(self, key: str) -> bool:
        """Tell whether an item is finished."""
        return self._path(key).is_file()

    def read(self, key: str) -> Item:
        """Read a finished item.

        Raises:
            Unavailable: ``build.damaged_item``, ``build.missing_item``.
        """
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
        # Copied, to be writable as what was computed is.
        return {name: array.copy() for name, array in arrays.items()}

    def _path(self, key: str) -> Path:
        return self.root / f"{key}.npz"


@contextmanager
def exclusive(lock: Path) -> Iterator[None]:
    """Hold a lock file against a second build; released when the process ends, however it ends.

    The file stays: removing it would let two builds hold locks of the same name.

    Raises:
        Conflict: ``build.running``.
    """
    lock.parent.mkdir(parents=True, exist_ok=True)
    with lock.open("a") as file:  # whatever it is, it stays as it is
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise refuse("build.running", field=str(lock)) from None
        yield
