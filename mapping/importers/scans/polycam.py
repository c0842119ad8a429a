"""Polycam's raw data: ``keyframes`` with images, cameras, depth and confidence.

Format: the README of PolyCam/polyform. The corrected images are without distortion, and their
cameras are optimized; depth is as the original camera saw it, in millimetres.
"""

from __future__ import annotations

from pathlib import Path

from mapping.importers.model import ImportedModel
from mapping.importers.reading.json_fields import JsonValue, read_json
from mapping.importers.reading.photo_names import natural_order
from mapping.importers.scans.frames import (
    ScanFrame,
    arkit_pose,
    link,
    photos_folder,
    pinhole,
    scan_model,
    unused_fields,
)
from visloc.errors import refuse
from visloc.geometry import MAX_IMAGE_SIDE, Camera

_POSE = [f"t_{row}{column}" for row in range(3) for column in range(4)]
_INTRINSICS, _SIZE = ["fx", "fy", "cx", "cy"], ["width", "height"]


def read(path: Path, photos: Path | None = None) -> ImportedModel:
    """Read raw data: the folder of a capture, or its ``keyframes``.

    Args:
        photos: for links to the photos and for depth maps; None makes ``<path>_photos``.

    Raises:
        DatasetError: ``import.json``, ``import.scan_*`` with the file; ``import.empty``.
    """
    scan = path / "keyframes" if (path / "keyframes").is_dir() else path
    kind = "corrected_" if (scan / "corrected_cameras").is_dir() else ""
    files = sorted((scan / f"{kind}images").glob("*.jpg"), key=lambda f: natural_order(f.name))
    described = {f: (scan / f"{kind}cameras" / f.name).with_suffix(".json") for f in files}
    tops = {file: read_json(camera) for file, camera in described.items() if camera.is_file()}
    if not tops:
        raise refuse("import.empty", field=str(scan), expected=f"{kind}images and {kind}cameras")
    with photos_folder(path, photos) as (folder, notes):
        if not kind:
            notes.append("there are no corrected images: those with distortion are used")
        if len(tops) < len(files):
            notes.append(f"{len(files) - len(tops)} of {len(files)} photos have no camera")
        frames = []
        for file, top in tops.items():
            original = scan / "cameras" / f"{file.stem}.json"
            link(file, folder / file.name)
            frames.append(
                ScanFrame(
                    file.name,
                    _camera(top),
                    arkit_pose([top[key].number() for key in _POSE], top.where),
                    scan / "depth" / f"{file.stem}.png",
                    scan / "confidence" / f"{file.stem}.png",
                    _camera(read_json(original)) if original.is_file() else None,
                )
            )
        notes += unused_fields([*tops.values()], [*_POSE, *_INTRINSICS, *_SIZE])
        return scan_model(frames, folder, notes)


def _camera(top: JsonValue) -> Camera:
    width, height = (top[key].integer(MAX_IMAGE_SIDE) for key in _SIZE)
    return pinhole([top[key].number() for key in _INTRINSICS], (width, height), top.where)
