"""Stray Scanner: ``rgb.mp4``, ``odometry.csv``, ``camera_matrix.csv``, depth and confidence.

Format: docs/format.md and OdometryEncoder.swift of strayrobots/scanner. Poses are camera to world
with our axes (x right, y down, z forward), of the pixels as stored. Frames of the film are the
lines of the odometry, one by one. Newer versions tell the intrinsics of each frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2

from mapping.films.sharpness import SHARPNESS_SIDE, sharpness
from mapping.films.video import Frame, frames_of, video_facts
from mapping.importers.model import ImportedModel
from mapping.importers.reading.text_lines import TextLines
from mapping.importers.scans.frames import (
    ScanFrame,
    photos_folder,
    pinhole,
    quaternion_pose,
    scan_model,
    starts_of_stretches,
    unused_fields,
)
from visloc.errors import refuse
from visloc.geometry import Camera

_FRAME, _POSE = "frame", ("x", "y", "z", "qx", "qy", "qz", "qw")
_INTRINSICS = ("fx", "fy", "cx", "cy")
_MOST_FRAMES = 10**6
_JPEG_QUALITY = 95


def read(path: Path, photos: Path | None = None) -> ImportedModel:
    """Read the folder of a recording; where the camera has moved, the sharpest frame is a photo.

    Args:
        photos: for the photos and depth maps that are written; None makes ``<path>_photos``.

    Raises:
        DatasetError: ``import.line``, ``import.scan_*`` with the file and line.
        InvalidInput, TooLarge: ``capture.video*``.
    """
    film, matrix = path / "rgb.mp4", path / "camera_matrix.csv"
    with TextLines(matrix) as lines:
        rows = [_fields(lines, lines.next("three numbers"), 3) for _ in range(3)]
        (fx, _, cx), (_, fy, cy), _ = ([lines.to_number(field) for field in row] for row in rows)
    if not film.is_file():
        raise refuse("import.missing", field=str(film))
    facts = video_facts(film)
    camera = pinhole([fx, fy, cx, cy], (facts.width, facts.height), str(matrix))
    recorded, unused = _odometry(path, camera)
    with photos_folder(path, photos) as (folder, notes):
        frames = list(_photos(film, recorded, folder))
        notes += [f"{len(frames)} of {len(recorded)} frames are used, where the camera has moved"]
        return scan_model(frames, folder, notes + unused)


def _fields(lines: TextLines, line: str, count: int) -> list[str]:
    fields = [field.strip() for field in line.split(",")]
    if len(fields) != count:
        raise lines.error("the line is not whole", expected=f"{count} fields", got=len(fields))
    return fields


def _odometry(path: Path, shared: Camera) -> tuple[list[ScanFrame], list[str]]:
    """Return the frames by the names of columns, and a note on columns that are not read."""
    frames = []
    with TextLines(path / "odometry.csv") as lines:
        names = [name.strip() for name in lines.next("names of columns").split(",")]
        if missing := [name for name in (_FRAME, *_POSE) if name not in names]:
            raise lines.error("a column is missing", expected=", ".join(missing), got=str(names))
        while (line := lines.next_or_none()) is not None:
            values = dict(zip(names, _fields(lines, line, len(names)), strict=True))
            where = f"{lines.path}:{lines.number}"
            pose = [lines.to_number(values[name]) for name in _POSE]
            camera = shared
            if all(values.get(name) for name in _INTRINSICS):
                own = [lines.to_number(values[name]) for name in _INTRINSICS]
                camera = pinhole(own, (shared.width, shared.height), where)
            frame = f"{lines.to_integer(values[_FRAME], _MOST_FRAMES):06d}"
            frames.append(
                ScanFrame(
                    f"{frame}.jpg",
                    camera,
                    quaternion_pose(pose[3:], pose[:3], where),
                    path / "depth" / f"{frame}.png",
                    path / "confidence" / f"{frame}.png",
                )
            )
    return frames, unused_fields(names, [_FRAME, *_POSE, *_INTRINSICS])


def _photos(film: Path, recorded: Sequence[ScanFrame], folder: Path) -> Iterator[ScanFrame]:
    """Write the sharpest frame of each stretch, and yield what was recorded with it."""
    starts = set(starts_of_stretches(recorded))
    best: tuple[float, ScanFrame, Frame] | None = None
    row = -1
    for row, frame in enumerate(frames_of(film)):
        if row >= len(recorded):
            break
        if row in starts and best is not None:
            yield _written(best[1], best[2], folder)
            best = None
        sharp = sharpness(frame.grey(SHARPNESS_SIDE))
        if best is None or sharp > best[0]:
            best = sharp, recorded[row], frame
    if row + 1 != len(recorded) or best is None:
        expected, got = f"{len(recorded)} frames", f"{row + 1} or more"
        raise refuse("import.scan_frames", field=str(film), expected=expected, got=got)
    yield _written(best[1], best[2], folder)


def _written(recorded: ScanFrame, frame: Frame, folder: Path) -> ScanFrame:
    bgr = cv2.cvtColor(frame.rgb(), cv2.COLOR_RGB2BGR)
    _, encoded = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    (folder / recorded.name).write_bytes(encoded.tobytes())
    return recorded
