"""Publishing the results of jobs: names of versions, and the files beside a map's arrays."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from visloc.archive import Map, MapContent, MapStore, write_map
from visloc.archive.anchoring import link_or_copy
from visloc.archive.schema import photo_file

PAIRS = "pairs.txt"


def photo_files(opened: Map) -> list[Path]:
    """Return a map's small photos in their order; none if it keeps none."""
    names = [photo_file(row) for row in range(len(opened.images))]
    return [opened.path / name for name in names if name in opened.manifest.files]


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
        Conflict: ``map.outdated`` when ``based_on`` is no longer the current version.
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


def link_photos(folder: Path, photos: Sequence[Path]) -> None:
    """Give a map the small photos, in their order, of another map."""
    for row, path in enumerate(photos):
        target = folder / photo_file(row)
        target.parent.mkdir(parents=True, exist_ok=True)
        link_or_copy(path, target)


def write_content(folder: Path, content: MapContent, map_id: str) -> str:
    """Write content beside the files that a folder has already; return its version."""
    version, created = new_version()
    return write_map(folder, content, map_id=map_id, version=version, created=created)


def new_version() -> tuple[str, str]:
    """Name a version after the current time: a prefix for its content hash, and ISO 8601 in UTC."""
    now = datetime.now(UTC)
    return now.strftime("%Y%m%dT%H%M%S.%f")[:-3] + "Z-", now.isoformat(timespec="seconds")
