"""Local copies of versions that lie in object storage, up to a number of bytes."""

from __future__ import annotations

import logging
import os
from contextlib import AbstractContextManager, suppress
from pathlib import Path

from visloc.archive.backends.folder import FolderBackend
from visloc.archive.version_rules import version_exists
from visloc.errors import refuse

logger = logging.getLogger(__name__)


class Copies:
    """A folder of copies, laid out as a folder of maps. The least recently used make room."""

    def __init__(self, root: Path, max_bytes: int) -> None:
        self.root = root
        self._folder, self._max_bytes = FolderBackend(root), max_bytes

    def get(self, map_id: str, version: str) -> Path | None:
        """The folder of a copy; None if there is none."""
        has_it = self._folder.has_version(map_id, version)
        return self._folder.local_folder(map_id, version) if has_it else None

    def used(self, copy: Path) -> Path:
        """Return a copy and note that it was used now."""
        with suppress(OSError):  # a copy on a read-only disk has no time of last use
            os.utime(copy)
        return copy

    def keep(self, incoming: Path, map_id: str, version: str) -> Path:
        """Take in a verified version."""
        with self._folder.changing():
            if self._folder.has_version(map_id, version):
                raise version_exists(map_id, version)
            return self._folder.publish(incoming, map_id, version, make_current=False)

    def remove(self, map_id: str, version: str) -> None:
        """Remove a copy if there is one."""
        with self._folder.changing():
            if not self._folder.has_version(map_id, version):
                return
            is_last = not set(self._folder.versions(map_id)) - {version}
            delete = self._folder.remove(map_id, version, is_last=is_last)
        delete()

    def make_room(self, size: int) -> None:
        """Delete the least recently used copies until a map of ``size`` bytes fits."""
        if size > self._max_bytes:
            raise refuse(
                "maps.storage_full",
                "the map is larger than the space for copies (max_cache_bytes)",
                field=str(self.root),
                expected=f"at least {size} bytes",
                got=f"{self._max_bytes} bytes",
            )
        copies = []
        for folder in self.root.glob("[!.]*/[!.]*"):
            with suppress(FileNotFoundError):  # another process with the same copies deletes it
                copies.append((folder.stat().st_mtime, size_of(folder), folder))
        used = sum(size for _, size, _ in copies)
        for _, freed, folder in sorted(copies):
            if used + size <= self._max_bytes:
                return
            logger.info("deleting the copy of %s@%s to make room", folder.parent.name, folder.name)
            self.remove(folder.parent.name, folder.name)
            used -= freed

    def incoming(self) -> AbstractContextManager[Path]:
        """Give an empty folder beside the copies, deleted in the end."""
        return self._folder.incoming()

    def sweep(self) -> None:
        """Delete what killed processes left behind."""
        self._folder.sweep()


def size_of(folder: Path) -> int:
    """Bytes of all files in a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
