"""Record3D: an ``.r3d`` file (a ZIP), its unpacked folder, or an export of photos and EXR depth.

Format: nerfstudio's reader and others that agree. ``metadata`` is JSON: K column by column, and
poses as qx qy qz qw x y z, camera to world with the camera's axes of ARKit, of photos as stored.
Depth is compressed with LZFSE, or EXR, and not read.
"""

from __future__ import annotations

import zipfile
import zlib
from dataclasses import replace
from pathlib import Path

from mapping.importers.model import ImportedModel
from mapping.importers.reading.json_fields import JsonValue, parse_json
from mapping.importers.reading.photo_names import photo_size
from mapping.importers.scans.frames import (
    OURS_FROM_ARKIT,
    ScanFrame,
    photos_folder,
    pinhole,
    quaternion_pose,
    scan_model,
    starts_of_stretches,
    unused_fields,
)
from visloc.errors import refuse
from visloc.geometry import MAX_IMAGE_SIDE, Camera
from visloc.images import FILE_LIMITS

_METADATA, _PHOTOS = ("metadata", "metadata.json"), ("rgbd/{}.jpg", "rgb/{}.jpg", "rgb/{}.png")
_FIELDS = ("K", "w", "h", "poses", "perFrameIntrinsicCoeffs")
# What zipfile raises on damaged files; those that are encrypted are a RuntimeError.
_DAMAGED = (zipfile.BadZipFile, RuntimeError, ValueError, EOFError, zlib.error)


def read(path: Path, photos: Path | None = None) -> ImportedModel:
    """Read an ``.r3d`` file or a folder; a frame is a photo where the camera has moved.

    Args:
        photos: for copies of the photos; None makes ``<path>_photos``.

    Raises:
        DatasetError: ``import.json``, ``import.scan_*``; ``import.empty``; ``import.unreadable``.
    """
    if path.is_dir():
        return _read(path, path, photos)
    try:
        with zipfile.ZipFile(path) as archive:
            largest = max((info.file_size for info in archive.infolist()), default=0)
            if largest > FILE_LIMITS.max_bytes:
                raise refuse("import.unreadable", field=str(path), got=f"a file of {largest} bytes")
            return _read(path, zipfile.Path(archive), photos)
    except _DAMAGED as error:
        raise refuse("import.unreadable", field=str(path), got=str(error)) from error


def _read(path: Path, scan: Path | zipfile.Path, photos: Path | None) -> ImportedModel:
    name = next((name for name in _METADATA if (scan / name).is_file()), None)
    if name is None:
        raise refuse("import.missing", field=str(path / _METADATA[0]))
    top = parse_json((scan / name).read_bytes(), path / name)
    poses = top["poses"].elements()
    recorded = []
    for row, values in enumerate(poses):
        file = next((f for p in _PHOTOS if (f := scan / p.format(row)).is_file()), None)
        if file is not None:
            q_and_center = values.numbers(7)
            pose = quaternion_pose(q_and_center[:4], q_and_center[4:], values.where)
            frame = ScanFrame(f"{row:06d}.jpg", _camera(top, row), OURS_FROM_ARKIT @ pose)
            recorded.append((frame, file))
    if not recorded:
        raise refuse("import.empty", field=str(path), expected=_PHOTOS[0].format(0))
    frames = []
    with photos_folder(path, photos) as (folder, notes):
        for start in starts_of_stretches([frame for frame, _ in recorded]):
            frame, file = recorded[start]
            (folder / frame.name).write_bytes(file.read_bytes())
            size = photo_size(folder / frame.name)
            if size is None or not frame.camera.has_aspect_of(*size):
                raise refuse("import.scan_camera", field=str(path / file.name), got=size)
            frames.append(replace(frame, camera=frame.camera.scaled(*size)))
        notes += [
            f"{len(frames)} of {len(poses)} frames are used, where the camera has moved",
            "depth of Record3D (LZFSE or EXR) is not read",
            *unused_fields([top], _FIELDS),
        ]
        return scan_model(frames, folder, notes)


def _camera(top: JsonValue, row: int) -> Camera:
    """Return the camera of a frame in the size that intrinsics are of; photos may be larger."""
    each = top.get("perFrameIntrinsicCoeffs")
    if each is not None and each.value:
        of_frames = each.elements()
        if row >= len(of_frames):
            raise each.error("frames are missing", expected=f"at least {row + 1}")
        params = of_frames[row].numbers(4)
    else:
        values = top["K"].numbers(9)
        params = [values[i] for i in (0, 4, 6, 7)]
    width, height = (top[key].integer(MAX_IMAGE_SIDE) for key in ("w", "h"))
    return pinhole(params, (width, height), top.where)
