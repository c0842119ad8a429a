"""Small pictures of the mapping photos, for maps that are to show them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2

from mapping.features import Progress
from mapping.photos import MappingPhoto
from mapping.workers import Workers
from visloc.archive.schema import MAX_PHOTO_SIDE, photo_file
from visloc.images import read_photo_file

_JPEG_QUALITY = 80


def keep_photos(
    folder: Path, photos: Sequence[MappingPhoto], workers: Workers, progress: Progress
) -> None:
    """Write small JPEGs of the photos, in this order, into the folder of a map.

    They hold the pixels as stored and nothing else: no EXIF, no place, no time.

    Raises:
        VislocError: what ``read_photo_file`` raises.
    """
    names = [photo_file(row) for row in range(len(photos))]
    for parent in {(folder / name).parent for name in names}:
        parent.mkdir(parents=True, exist_ok=True)
    items = [_Item(photo.path, folder / name) for photo, name in zip(photos, names, strict=True)]
    workers.run(_keep, items, partial(progress, "small photos"))


@dataclass(frozen=True, slots=True)
class _Item:
    photo: Path
    output: Path


def _keep(item: _Item) -> None:
    rgb = read_photo_file(item.photo).rgb
    height, width = rgb.shape[:2]
    scale = min(1.0, MAX_PHOTO_SIDE / max(width, height))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
    bgr = cv2.cvtColor(small, cv2.COLOR_RGB2BGR)
    encoded = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1]
    item.output.write_bytes(encoded.tobytes())
