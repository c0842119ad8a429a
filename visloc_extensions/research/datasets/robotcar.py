"""RobotCar Seasons.

Layout after the README of the archive (visuallocalization.net) and hloc's ``pipelines/RobotCar``:
photos ``images/CONDITION/CAMERA/TIMESTAMP.jpg``, undistorted, 1024 x 1024 pixels;
``intrinsics/CAMERA_intrinsics.txt`` with lines ``fx VALUE``, then fy, cx and cy, for the cameras
left, rear and right; ``3D-models/all-merged/all.nvm`` with the poses of the photos of
``overcast-reference``, whose names begin with ``./`` and may end in ``.png``. All other conditions
are queries, whose poses are not published here.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from visloc.errors import DatasetError, InvalidInput, refuse
from visloc.geometry import Camera, Pose
from visloc.kapture import Dataset, FileRecord, Sensor
from visloc_extensions.importers import nvm
from visloc_extensions.research.datasets.photo_lists import check_photos
from visloc_extensions.research.datasets.text import read_lines

_CAMERAS = ("left", "rear", "right")
_SIDE = 1024
_REFERENCE = "overcast-reference"


def read_robotcar(folder: Path) -> Mapping[str, Dataset]:
    """Read the photos of the reference condition, and those of all others."""
    sensors = {name: Sensor.with_camera(name, _camera(folder, name)) for name in _CAMERAS}
    model, root = folder / "3D-models" / "all-merged" / "all.nvm", folder / "images"
    if not model.is_file():
        raise refuse("archive.missing", field=str(model), expected="the model of VisualSFM")
    poses = {
        f"{name.removeprefix('./').rpartition('.')[0]}.jpg": pose
        for name, pose in nvm.read_poses(model).items()
    }
    check_photos(root, poses)
    found = sorted(path.relative_to(root).as_posix() for path in root.glob("*/*/*.jpg"))
    queries = [name for name in found if not name.startswith(f"{_REFERENCE}/")]
    if not queries:
        raise refuse("archive.missing", field=str(root), expected="night/rear/TIMESTAMP.jpg ...")
    return {
        "mapping": _made(root, sensors, poses, poses),
        "query": _made(root, sensors, queries, {}),
    }


def _camera(folder: Path, name: str) -> Camera:
    path = folder / "intrinsics" / f"{name}_intrinsics.txt"
    expected = "lines fx VALUE, fy VALUE, cx VALUE, cy VALUE"
    fields = [line.split() for line in read_lines(path, expected)][:4]
    try:
        values = tuple(float(value) for _, value in fields)
        return Camera("PINHOLE", _SIDE, _SIDE, values)
    except ValueError:
        got = " / ".join(" ".join(line) for line in fields)
        raise refuse("archive.content", field=str(path), expected=expected, got=got) from None
    except InvalidInput as error:
        raise error.about(str(path), DatasetError) from None


def _made(
    root: Path, sensors: Mapping[str, Sensor], names: Iterable[str], poses: Mapping[str, Pose]
) -> Dataset:
    images, trajectories = [], {}
    for name in names:
        _, camera, file = name.split("/") if name.count("/") == 2 else ("", "", "")
        time = file.removesuffix(".jpg")
        if camera not in sensors or not (time.isdecimal() and len(time) <= 18):
            expected = "CONDITION/CAMERA/TIMESTAMP.jpg"
            raise refuse("archive.content", field=str(root), expected=expected, got=name)
        images.append(FileRecord(int(time), camera, name))
        if name in poses:
            trajectories[int(time), camera] = poses[name]
    return Dataset(
        root=root,
        sensors=sensors,
        rigs={},
        trajectories=trajectories,
        images=tuple(images),
        depth_maps=(),
        gnss=(),
    )
