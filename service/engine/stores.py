"""The store of maps: a folder, or a URL that fsspec supports."""

from __future__ import annotations

from pathlib import Path

from visloc.archive import MapStore, open_remote_store


def open_store(maps_dir: str, cache_dir: Path, max_cache_bytes: int) -> MapStore:
    """Return the store in a folder or at a URL; the cache is for a URL."""
    if "://" in maps_dir:
        try:
            return open_remote_store(maps_dir, cache_dir, max_cache_bytes)
        except (ImportError, ValueError) as error:  # a protocol that is not known or not installed
            raise ValueError(f"the URL cannot be used: {error}") from None
    folder = Path(maps_dir)
    # One that is not there is misspelt, or not mounted: its service would be ready without maps.
    if not maps_dir or not folder.is_dir():
        raise ValueError(f"{maps_dir!r} is no folder; make it if it is to hold maps")
    return MapStore(folder)
