"""Publishing maps that took their own test."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mapping.own_test.trials import own_test
from mapping.stages.publishing import link_photos, new_version
from visloc.archive import MapContent, MapStore, add_own_test, open_map, write_map


def publish_edited(
    store: MapStore,
    content: MapContent,
    map_id: str,
    *,
    photos: Sequence[Path] = (),
    based_on: str | None = None,
) -> Path:
    """Publish content made from maps as the current version of a map.

    Args:
        photos: small copies of all photos, in their order; or none.
        based_on: the version that the content was made from, if it is one of the same map.

    Returns:
        The folder of the new version.

    Raises:
        Conflict: ``map.outdated`` when ``based_on`` is no longer the version in use.
    """
    if photos and len(photos) != len(content.images):
        raise AssertionError(f"{len(photos)} pictures of {len(content.images)} photos")
    with store.incoming() as incoming:
        link_photos(incoming, photos)
        return publish_content(store, incoming, content, map_id, based_on=based_on)


def publish_content(
    store: MapStore,
    incoming: Path,
    content: MapContent,
    map_id: str,
    *,
    based_on: str | None = None,
) -> Path:
    """Write content beside the files that a folder has already, and publish it.

    Raises:
        Conflict: ``map.outdated``.
    """
    version = write_content(incoming, content, map_id)
    return store.publish(incoming, map_id, version, based_on=based_on)


def write_content(folder: Path, content: MapContent, map_id: str) -> str:
    """Write content beside the files that a folder has already, test it, and return its version.

    What the content knows of the map it was made from is learned anew.
    """
    version, created = new_version()
    write_map(folder, content, map_id=map_id, version=version, created=created)
    return add_own_test(folder, own_test(open_map(folder)), version=version)
