"""The store of maps: a folder, or a URL that fsspec supports."""

from __future__ import annotations

import logging
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Protocol

from visloc.archive import MapOutline, MapStore, SetOutline

logger = logging.getLogger(__name__)


class Store(Protocol):
    """A store of maps. All methods block, and are safe in several threads.

    ``visloc.archive.MapStore`` documents the errors. A remote store also raises Unavailable
    ``maps.storage_away``.
    """

    @property
    def reachable(self) -> bool:
        """Whether the store answered the last request."""
        ...

    def ids(self) -> list[str]:
        """Ids of the maps that have a current version, sorted."""
        ...

    def versions(self, map_id: str) -> list[str]:
        """Published versions of a map, oldest first."""
        ...

    def current_version(self, map_id: str) -> str: ...

    def outline(self, ref: str) -> MapOutline | SetOutline:
        """The description of ``id`` or ``id@version``; quick, also in a remote store."""
        ...

    def at_hand(self, ref: str) -> Path | None:
        """The folder of ``id@version``; None when it must be fetched first."""
        ...

    def folder(self, ref: str) -> Path:
        """The local folder ``.../<id>/<version>`` of ``id`` or ``id@version``.

        A remote store fetches it first, which can take minutes.
        """
        ...

    def publish(
        self, incoming: Path, map_id: str, version: str, *, make_current: bool = True
    ) -> Path:
        """Verify every byte of a map, move it into the store, and return its local folder.

        ``incoming`` is a folder within the one that ``incoming()`` gave.
        """
        ...

    def set_current(self, map_id: str, version: str) -> None: ...

    def remove(self, map_id: str, version: str) -> None:
        """Remove a version; with the last one, the map."""
        ...

    def incoming(self) -> AbstractContextManager[Path]:
        """Give an empty folder to receive a map in; it is deleted in the end."""
        ...

    def sweep(self) -> None:
        """Delete what uploads of killed processes left behind; for the start."""
        ...


def open_store(maps_dir: str, cache_dir: Path, max_cache_bytes: int) -> Store:
    """Return the store in a folder or at a URL; the cache is for a URL.

    Raises:
        ValueError: the URL cannot be used, or the path is not a folder.
    """
    if "://" in maps_dir:
        from visloc.archive.remote_store import RemoteMapStore  # its libraries take long to load

        try:
            return RemoteMapStore(maps_dir, cache_dir, max_cache_bytes)
        except (ImportError, ValueError) as error:  # a protocol that is not known or not installed
            raise ValueError(f"the URL cannot be used: {error}") from None
    folder = Path(maps_dir)
    if not maps_dir or (folder.exists() and not folder.is_dir()):
        raise ValueError(f"{maps_dir!r} is no folder")
    if not folder.exists():
        logger.warning("maps_dir: %s does not exist yet; the first map creates it", folder)
    return MapStore(folder)
