"""Small copies of the mapping photos, for maps that show them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import cv2

from mapping.stages.context import BuildContext
from mapping.stages.photos import MappingPhoto
from mapping.stages.work_folder import Item, WorkFolder, key_of
from visloc.archive.schema import MAX_PHOTO_SIDE, photo_file

_JPEG_QUALITY = 80
# Raised when the code of the stage changes what comes out.
_REVISION = 1


def keep_photos(context: BuildContext, folder: Path, photos: Sequence[MappingPhoto]) -> None:
    """Write small JPEGs of the photos, in this order, into the folder of a map.

    They hold pixels in the frame of the photo's camera, and no metadata such as EXIF, place or
    time.
    """
    context.run("small photos", partial(_keep, context.work), photos)
    for row, photo in enumerate(photos):
        output = folder / photo_file(row)
        output.parent.mkdir(parents=True, exist_ok=True)
        output.write_bytes(context.work.read(_key(photo))["jpeg"].tobytes())


def _key(photo: MappingPhoto) -> str:
    size = [photo.camera.width, photo.camera.height]
    return key_of("small_photos", _REVISION, photo=photo.sha256, size=size)


def _keep(work: WorkFolder, photo: MappingPhoto) -> None:
    work.get(_key(photo), partial(_small, photo))


def _small(photo: MappingPhoto) -> Item:
    rgb = photo.read().rgb
    height, width = rgb.shape[:2]
    scale = min(1.0, MAX_PHOTO_SIDE / max(width, height))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
    bgr = cv2.cvtColor(small, cv2.COLOR_RGB2BGR)
    encoded = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1]
    return {"jpeg": encoded}
