"""3D Scanner App's "All data": ``frame_00000.json`` with photo, depth and confidence beside it.

Format: what readers of it agree on, such as PSegs. Matrices are row by row. Most frames have no
photo. Depth is PNGs in millimetres, or EXR, which is not read.
"""

from __future__ import annotations

from pathlib import Path

from mapping.importers.model import ImportedModel
from mapping.importers.reading.json_fields import read_json
from mapping.importers.reading.photo_names import natural_order, photo_size
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

_POSE, _INTRINSICS = "cameraPoseARFrame", "intrinsics"


def read(path: Path, photos: Path | None = None) -> ImportedModel:
    """Read the folder of a scan.

    Args:
        photos: for links to the photos and for depth maps; None makes ``<path>_photos``.

    Raises:
        DatasetError: ``import.json``, ``import.scan_*`` with the file; ``import.empty``.
    """
    files = sorted(path.glob("frame_*.json"), key=lambda file: natural_order(file.name))
    tops = {f.stem: read_json(f) for f in files if f.with_suffix(".jpg").is_file()}
    if not tops:
        raise refuse("import.empty", field=str(path), expected="frame_00000.jpg and others")
    with photos_folder(path, photos) as (folder, notes):
        frames = []
        for stem, top in tops.items():
            photo = path / f"{stem}.jpg"
            size, values = photo_size(photo), top[_INTRINSICS].numbers(9)
            assert size is not None  # the file is there
            link(photo, folder / photo.name)
            number = stem.removeprefix("frame_")
            frames.append(
                ScanFrame(
                    photo.name,
                    pinhole([values[i] for i in (0, 4, 2, 5)], size, top.where),
                    arkit_pose(top[_POSE].numbers(16), top.where),
                    path / f"depth_{number}.png",
                    path / f"conf_{number}.png",
                )
            )
        notes += unused_fields([*tops.values()], [_POSE, _INTRINSICS])
        if len(files) > len(frames):
            notes.append(f"{len(files) - len(frames)} of {len(files)} frames have no photo")
        return scan_model(frames, folder, notes)
