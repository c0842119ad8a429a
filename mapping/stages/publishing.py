"""Names of versions, and the files beside a map's arrays."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from visloc.archive import Map
from visloc.archive.anchoring import link_or_copy
from visloc.archive.schema import photo_file

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
