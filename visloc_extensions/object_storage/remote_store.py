"""A store of maps at a URL."""

from __future__ import annotations

from pathlib import Path

from visloc.archive.store import MapStore
from visloc_extensions.object_storage.objects import ObjectBackend


class RemoteMapStore(MapStore):
    """The maps of a URL that fsspec knows, with copies on this machine."""

    def __init__(self, url: str, cache_dir: Path, max_cache_bytes: int) -> None:
        """Nothing is asked of the storage yet.

        Args:
            url: as fsspec has it. Credentials come from the environment, as the storage's own
                tools read them; any that the URL carries are never shown.
            cache_dir: folder of the copies; several URLs may share it.
            max_cache_bytes: room for copies; the least recently used are deleted first.
        """
        backend = ObjectBackend(url, cache_dir, max_cache_bytes)
        self.root, self.backend = backend.copies.root, backend
        self.url = backend.storage.url
