"""A folder of maps: ``<maps-dir>/<id>/<version>/`` and ``<maps-dir>/<id>/current``.

Several threads and processes may read and change one folder. Readers take no lock: every change
becomes visible by one rename. A change holds the lock ``<maps-dir>/.lock``, so that what it found
is still true when it renames.
"""

from __future__ import annotations

import errno
import fcntl
import os
import secrets
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path

from visloc.archive.backends.base import CURRENT, MANIFEST, text_of_current
from visloc.archive.checks import check_files, read_any_manifest
from visloc.archive.reader import MapOutline
from visloc.archive.schema import ID_PATTERN
from visloc.archive.set_outline import SetOutline, read_any_outline
from visloc.archive.set_rules import AnyManifest
from visloc.archive.version_rules import refuse_renamed
from visloc.errors import MapCorrupt, refuse

INCOMING, REMOVED = ".incoming", ".removed-"
FULL = (errno.ENOSPC, errno.EDQUOT)


class FolderBackend:
    """The backend of a folder; ``Backend`` says what each method does."""

    is_local = True
    reachable = True

    def __init__(self, root: Path) -> None:
        self.root = root

    def ids(self) -> list[str]:
        return [name for name in _names_in(self.root) if (self.root / name / CURRENT).is_file()]

    def versions(self, map_id: str) -> list[str]:
        folder = self.root / map_id
        return [name for name in _names_in(folder) if (folder / name / MANIFEST).is_file()]

    def current(self, map_id: str) -> str | None:
        try:
            return text_of_current((self.root / map_id / CURRENT).read_bytes())
        except FileNotFoundError:
            return None
        except OSError as error:
            return f"unreadable: {error.strerror}"

    def has_version(self, map_id: str, version: str) -> bool:
        return (self.root / map_id / version).is_dir()

    def has_file(self, map_id: str, version: str, name: str) -> bool:
        return (self.root / map_id / version / name).is_file()

    def address(self, *names: str) -> str:
        return str(self.root.joinpath(*names))

    def manifests(
        self, refs: Sequence[tuple[str, str]]
    ) -> Iterator[AnyManifest | MapCorrupt | None]:
        for map_id, version in refs:
            try:
                yield read_any_manifest(self.root / map_id / version)
            except MapCorrupt as error:
                yield error if self.has_version(map_id, version) else None

    def local_folder(self, map_id: str, version: str) -> Path:
        return self.root / map_id / version

    folder = local_folder

    def outline(self, map_id: str, version: str) -> MapOutline | SetOutline:
        folder = self.root / map_id / version
        outline = read_any_outline(folder)
        check_files(folder, outline.manifest)
        refuse_renamed(outline.manifest, str(folder), map_id, version)
        return outline

    @contextmanager
    def changing(self) -> Iterator[None]:
        with storage_errors(self.root):
            self.root.mkdir(parents=True, exist_ok=True)
            with (self.root / ".lock").open("w") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                yield

    def publish(
        self,
        incoming: Path,
        map_id: str,
        version: str,
        *,
        make_current: bool,
        based_on: str | None = None,
    ) -> Path:
        del based_on  # the lock keeps other publishers out
        target = self.root / map_id / version
        target.parent.mkdir(parents=True, exist_ok=True)
        for folder in (*(path for path in incoming.rglob("*") if path.is_dir()), incoming):
            _sync_folder(folder)
        if make_current:  # first what a full disk could refuse
            switch = _prepare_current(target.parent, version)
        incoming.rename(target)
        _sync_folder(target.parent)
        _sync_folder(self.root)
        if make_current:
            switch.replace(target.parent / CURRENT)
            _sync_folder(target.parent)
        return target

    def set_current(self, map_id: str, version: str) -> None:
        parent = self.root / map_id
        _prepare_current(parent, version).replace(parent / CURRENT)
        _sync_folder(parent)

    def withdraw(self, map_id: str) -> None:
        parent = self.root / map_id
        (parent / CURRENT).unlink(missing_ok=True)
        _sync_folder(parent)

    def remove(self, map_id: str, version: str, *, is_last: bool) -> Callable[[], object]:
        leaving = self.root / map_id if is_last else self.root / map_id / version
        # Beside where it was, as a full disk may have no room for another folder.
        removed = leaving.with_name(f"{REMOVED}{secrets.token_hex(8)}")
        leaving.rename(removed)
        _sync_folder(removed.parent)
        return partial(shutil.rmtree, removed, ignore_errors=True)

    @contextmanager
    def incoming(self) -> Iterator[Path]:
        self.sweep()
        folder = self.root / INCOMING / secrets.token_hex(8)
        lock = folder.with_suffix(".lock")
        with storage_errors(self.root), ExitStack() as holding:
            with self.changing():
                folder.parent.mkdir(exist_ok=True)
                # Held while the folder is in use: a process id means nothing in another container.
                fcntl.flock(holding.enter_context(lock.open("w")), fcntl.LOCK_EX)
            try:
                folder.mkdir()
                yield folder
            finally:
                shutil.rmtree(folder, ignore_errors=True)
                lock.unlink(missing_ok=True)

    def sweep(self) -> None:
        for removed in (*self.root.glob(f"{REMOVED}*"), *self.root.glob(f"*/{REMOVED}*")):
            shutil.rmtree(removed, ignore_errors=True)
        parent = self.root / INCOMING
        if not parent.is_dir() or not os.access(parent, os.W_OK):
            return
        with ExitStack() as holding, self.changing():
            for path in parent.glob("*.lock"):
                lock = holding.enter_context(path.open("w"))
                with suppress(BlockingIOError):
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    holding.callback(path.unlink, missing_ok=True)
                    holding.callback(shutil.rmtree, path.with_suffix(""), ignore_errors=True)


@contextmanager
def storage_errors(place: Path) -> Iterator[None]:
    """Turn a full or read-only disk into an error for users."""
    try:
        yield
    except OSError as error:
        if error.errno in FULL:
            raise refuse("maps.storage_full", field=str(place)) from error
        if error.errno in (errno.EROFS, errno.EACCES, errno.EPERM):
            raise refuse("maps.read_only", field=str(place), got=error.strerror) from error
        raise


def _names_in(folder: Path) -> list[str]:
    try:
        return sorted(path.name for path in folder.iterdir() if ID_PATTERN.fullmatch(path.name))
    except (FileNotFoundError, NotADirectoryError):  # another process may have removed it
        return []


def _prepare_current(folder: Path, version: str) -> Path:
    """Write the file that replaces ``current``; only under the lock, as its name is fixed."""
    switch = folder / f".{CURRENT}.new"
    with switch.open("w", encoding="ascii") as file:
        file.write(version + "\n")
        file.flush()
        os.fsync(file.fileno())
    return switch


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
