"""Where maps come from: a folder, or a URL that fsspec knows."""

from __future__ import annotations

import logging
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Protocol

from service.settings import ServiceSettings, SettingsError
from visloc.archive import MapOutline, MapStore, SetOutline

logger = logging.getLogger(__name__)


class Store(Protocol):
    """What a place of maps can do. All of it blocks; safe to use from several threads.

    Docstrings of ``visloc.archive.MapStore`` say what each raises. A store that is not on this
    machine raises Unavailable ``maps.storage_away`` too.
    """

    @property
    def reachable(self) -> bool:
        """Whether the place answered when it was last asked."""
        ...

    def ids(self) -> list[str]:
        """Ids of the maps that have a current version, sorted."""
        ...

    def versions(self, map_id: str) -> list[str]:
        """Published versions of a map, oldest first."""
        ...

    def current_version(self, map_id: str) -> str:
        """The version in use."""
        ...

    def outline(self, ref: str) -> MapOutline | SetOutline:
        """What ``id`` or ``id@version`` says about itself; quick, wherever the store is."""
        ...

    def at_hand(self, ref: str) -> Path | None:
        """``folder`` of ``id@version`` if it is quick, None when it is to be fetched first."""
        ...

    def folder(self, ref: str) -> Path:
        """The local folder ``.../<id>/<version>`` of ``id`` or ``id@version``.

        A store that is not on this machine fetches it first, which can take minutes.
        """
        ...

    def publish(
        self, incoming: Path, map_id: str, version: str, *, make_current: bool = True
    ) -> Path:
        """Verify every byte of a map, give it its place, and make it current; the local folder.

        ``incoming`` is a folder within what ``incoming()`` gave.
        """
        ...

    def set_current(self, map_id: str, version: str) -> None:
        """Make a published version the one in use."""
        ...

    def remove(self, map_id: str, version: str) -> None:
        """Remove a version; with the last one, the map."""
        ...

    def incoming(self) -> AbstractContextManager[Path]:
        """Give an empty folder where a map can be received, deleted in the end."""
        ...

    def sweep(self) -> None:
        """Delete what uploads left behind whose process was killed; for the start."""
        ...


def open_store(settings: ServiceSettings) -> Store:
    """Return the store that ``maps_dir`` names.

    Raises:
        SettingsError: for a URL that cannot be used, and for what is no folder.
    """
    if "://" in settings.maps_dir:
        from visloc.archive.remote_store import RemoteMapStore  # its libraries take long to load

        try:
            return RemoteMapStore(settings.maps_dir, settings.cache_dir, settings.max_cache_bytes)
        except (ImportError, ValueError) as error:  # a protocol that is not known or not installed
            raise SettingsError(f"maps_dir: the URL cannot be used: {error}") from None
    folder = Path(settings.maps_dir)
    if not settings.maps_dir or (folder.exists() and not folder.is_dir()):
        raise SettingsError(f"maps_dir: {settings.maps_dir!r} is no folder")
    if not folder.exists():
        logger.warning("maps_dir: %s is not there yet; it is made with the first map", folder)
    return MapStore(folder)
