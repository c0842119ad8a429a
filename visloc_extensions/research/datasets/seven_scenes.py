"""Microsoft's RGB-D Dataset 7-Scenes: one scene.

Layout, from the project page (microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes) as
kapture's ``kapture_import_7scenes.py`` cites it: a folder ``seq-XX`` for each sequence, in which a
frame has ``frame-XXXXXX.color.png``, ``.depth.png`` (16 bits, millimetres, 65535 for none) and
``.pose.txt`` (camera to world, 4 x 4). ``TrainSplit.txt`` and ``TestSplit.txt`` have a line
``sequence1`` for each sequence.

The poses are those of the depth camera, which KinectFusion tracked with a focal length of 585. The
authors calibrated neither camera: as kapture's published copy, the colour camera has 525 and the
usual place of a Kinect's.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from visloc.errors import refuse
from visloc.geometry import Camera, Pose
from visloc.kapture import Dataset, FileRecord, Sensor
from visloc_extensions.research.datasets.text import read_lines

_SPLITS = {"mapping": "TrainSplit.txt", "query": "TestSplit.txt"}
_ONE_SCENE = "lines such as sequence1, in the folder of one scene"
_SEQUENCE = re.compile(r"sequence\s*(\d{1,3})")
_FRAME = re.compile(r"frame-(\d{6})\.color\.png")
_RIG, _COLOUR, _DEPTH = "kinect", "kinect_rgb", "kinect_depth"
_SENSORS = {
    _COLOUR: Sensor.with_camera(
        _COLOUR, Camera("SIMPLE_PINHOLE", 640, 480, (525.0, 320.0, 240.0)), name=_COLOUR
    ),
    _DEPTH: Sensor.with_camera(
        _DEPTH, Camera("SIMPLE_PINHOLE", 640, 480, (585.0, 320.0, 240.0)), "depth", _DEPTH
    ),
}
_COLOUR_FROM_DEPTH = Pose.from_quaternion(
    (0.99998297, 0.00408064, -0.00394659, -0.00135438), (-0.02555894, 0.0001011, 0.00203183)
)
# A frame's time: its sequence, then its number.
_FRAMES_PER_SEQUENCE = 1_000_000
_MAX_ROTATION_ERROR = 1e-3


def read_seven_scenes(folder: Path) -> Mapping[str, Dataset]:
    """Read the mapping and the query sequences of a scene, such as ``7scenes/chess``."""
    return {
        part: _read(folder, [_sequence_of(path, line) for line in read_lines(path, _ONE_SCENE)])
        for part, path in ((part, folder / name) for part, name in _SPLITS.items())
    }


def _sequence_of(path: Path, line: str) -> int:
    found = _SEQUENCE.fullmatch(line)
    if found is None:
        raise refuse("archive.content", field=str(path), expected="sequence1", got=line)
    return int(found[1])


def _read(folder: Path, sequences: list[int]) -> Dataset:
    images, depth_maps, poses = [], [], {}
    for sequence in sorted(set(sequences)):
        name = f"seq-{sequence:02}"
        if not (folder / name).is_dir():
            zipped = folder / f"{name}.zip"
            expected = f"{zipped.name} unpacked" if zipped.is_file() else "the sequence's folder"
            raise refuse("archive.missing", field=str(folder / name), expected=expected)
        names = sorted(path.name for path in (folder / name).iterdir())
        frames = [found for found in map(_FRAME.fullmatch, names) if found is not None]
        if not frames:
            expected = "frame-000000.color.png and so on"
            raise refuse("archive.missing", field=str(folder / name), expected=expected)
        for frame in frames:
            timestamp = sequence * _FRAMES_PER_SEQUENCE + int(frame[1])
            stem = f"{name}/frame-{frame[1]}"
            images.append(FileRecord(timestamp, _COLOUR, f"{stem}.color.png"))
            if not (folder / f"{stem}.depth.png").is_file():
                raise refuse("archive.missing", field=str(folder / f"{stem}.depth.png"))
            depth_maps.append(FileRecord(timestamp, _DEPTH, f"{stem}.depth.png"))
            poses[timestamp, _RIG] = _pose(folder / f"{stem}.pose.txt").inverse()
    return Dataset(
        root=folder,
        sensors=_SENSORS,
        rigs={_RIG: {_COLOUR: _COLOUR_FROM_DEPTH, _DEPTH: Pose.identity()}},
        trajectories=poses,
        images=tuple(images),
        depth_maps=tuple(depth_maps),
        gnss=(),
    )


def _pose(path: Path) -> Pose:
    """Read world_from_depth; the matrix is rounded, so its rotation is the nearest one."""
    try:
        text = path.read_text(encoding="utf-8-sig")
        matrix = np.array([float(word) for word in text.split()]).reshape(4, 4)
    except FileNotFoundError:
        raise refuse("archive.missing", field=str(path)) from None
    except (OSError, ValueError) as error:
        raise refuse("archive.content", field=str(path), got=str(error)) from error
    if np.isfinite(matrix).all() and np.array_equal(matrix[3], [0, 0, 0, 1]):
        left, stretch, right = np.linalg.svd(matrix[:3, :3])
        is_rotation = (np.abs(stretch - 1.0) <= _MAX_ROTATION_ERROR).all()
        if is_rotation and np.linalg.det(matrix[:3, :3]) > 0:
            return Pose(left @ right, matrix[:3, 3].copy())
    expected = "a 4 x 4 matrix of a rotation and a translation"
    raise refuse("archive.content", field=str(path), expected=expected, got=text.strip())
