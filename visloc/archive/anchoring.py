"""A map with another anchor: a new manifest over the same files."""

from __future__ import annotations

import errno
import json
import os
import shutil
from pathlib import Path

from visloc.archive.files import Files
from visloc.archive.places import down_of
from visloc.archive.reader import Map
from visloc.archive.schema import Anchor

# Errors of file systems that have no hard links, or none between two folders.
_NO_LINKS = (errno.EXDEV, errno.EPERM, errno.EMLINK, errno.ENOTSUP)


def write_anchored(opened: Map, folder: Path, anchor: Anchor, *, version: str, created: str) -> str:
    """Write a map with another anchor into an empty folder.

    Landmarks and photos keep their coordinates. Both versions share their files through hard links
    where the file system has them; otherwise they are copied. Gravity follows the new anchor if it
    was unknown or came from the old anchor; a direction from elsewhere is kept.

    Args:
        opened: the map, which stays as it is.
        folder: exists and is empty.
        anchor: the new anchor.
        version: the version, or a prefix ending in ``-``, to which a part of the content hash is
            appended.
        created: ISO 8601 in UTC.

    Returns:
        The version.
    """
    manifest = json.loads((opened.path / "manifest.json").read_text(encoding="utf-8"))
    major, minor = map(int, opened.manifest.format_version.split("."))
    # The files stay as they are, and so do the formats that can read them. Format 1.3 introduced
    # such anchors.
    manifest["format_version"] = "{}.{}".format(*max((major, minor), (1, 3)))
    world = manifest["world"]
    if anchor.geodetic is not None and (world.get("gravity") is None or opened.geodetic):
        world["gravity"] = down_of(anchor.geodetic).tolist()
    world["anchor"] = anchor.model_dump()
    for name in opened.manifest.files:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        link_or_copy(opened.path / name, folder / name)
    manifest["created"] = created
    return Files(folder).finish(manifest, version)


def link_or_copy(source: Path, target: Path) -> None:
    """Share a file between two maps: as a hard link if possible, otherwise as a copy."""
    try:
        target.hardlink_to(source)
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        shutil.copyfile(source, target)
        with target.open("rb") as file:
            os.fsync(file.fileno())
