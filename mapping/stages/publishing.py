"""Names and locks of versions, and the files beside a map's arrays."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from mapping.stages.work_folder import exclusive
from visloc.archive import Map, MapStore
from visloc.archive.anchoring import link_or_copy
from visloc.archive.schema import photo_file
from visloc.archive.version_rules import outdated

PAIRS = "pairs.txt"


def photo_files(opened: Map) -> list[Path]:
    """Return a map's small photos in their order; none if it keeps none."""
    names = [photo_file(row) for row in range(len(opened.images))]
    return [opened.path / name for name in names if name in opened.manifest.files]


def link_photos(folder: Path, photos: Sequence[Path]) -> None:
    """Give a map the small photos, in their order, of another map."""
    for row, path in enumerate(photos):
        target = folder / photo_file(row)
        target.parent.mkdir(parents=True, exist_ok=True)
        link_or_copy(path, target)


def new_version() -> tuple[str, str]:
    """Name a version after the current time: a prefix for its content hash, and ISO 8601 in UTC."""
    now = datetime.now(UTC)
    return now.strftime("%Y%m%dT%H%M%S.%f")[:-3] + "Z-", now.isoformat(timespec="seconds")


@contextmanager
def sole_publisher(maps_dir: Path, map_id: str) -> Iterator[None]:
    """Hold a map's lock, so that one job at a time makes versions of it."""
    with exclusive(maps_dir / ".work" / f"{map_id}.lock"):
        yield


@contextmanager
def successor_of(opened: Map, store: MapStore) -> Iterator[None]:
    """Hold a map's lock while a version is made that replaces this one, its current one."""
    map_id, version = opened.manifest.id, opened.manifest.version
    with sole_publisher(store.root, map_id):
        if (current := store.current_version(map_id)) != version:
            raise outdated(map_id, version, current)
        yield
