"""Extended CMU Seasons: one slice, such as ``slice7``.

Layout after the README of the archive (visuallocalization.net) and kapture's
``kapture_import_Extended_CMU_Seasons.py``: ``intrinsics.txt`` lies beside the slices and has a line
``c0 OPENCV 1024 768 fx fy cx cy k1 k2 p1 p2`` for each of the two cameras. A slice has the photos
``database/`` and ``query/``, ``ground-truth-database-images-slice7.txt`` (name, quaternion of
cam_from_world, centre) and ``test-images-slice7.txt`` (names). ``camera-poses/*.txt``, in the
format of the first list, has poses of queries where they are published. The name
``img_00122_c0_1303398475046031us.jpg`` tells camera and time.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from visloc.errors import refuse
from visloc.geometry import Camera, Pose
from visloc.kapture import Dataset, FileRecord, Sensor
from visloc_extensions.research.datasets.photo_lists import check_photos, read_cameras, read_centers
from visloc_extensions.research.datasets.text import read_lines

_NAME = re.compile(r"img_\d+_(c\d+)_(\d{1,18})us(?:_rect)?\.jpg")


def read_cmu(folder: Path) -> Mapping[str, Dataset]:
    """Read database and query photos of a slice."""
    cameras = read_cameras(folder.resolve().parent / "intrinsics.txt")
    slice_name = folder.resolve().name
    database = folder / f"ground-truth-database-images-{slice_name}.txt"
    queries = folder / f"test-images-{slice_name}.txt"
    poses = read_centers(database)
    known: dict[str, Pose] = {}
    for path in sorted((folder / "camera-poses").glob("*.txt")):
        known |= read_centers(path) if path.stat().st_size else {}
    listed = [line.split()[0] for line in read_lines(queries, "a name in each line")]
    names = dict.fromkeys([*listed, *known])
    return {
        "mapping": _made(folder / "database", database, cameras, poses, poses),
        "query": _made(folder / "query", queries, cameras, names, known),
    }


def _made(
    root: Path,
    source: Path,
    cameras: Mapping[str, Camera],
    names: Iterable[str],
    poses: Mapping[str, Pose],
) -> Dataset:
    images, trajectories = [], {}
    for name in names:
        found = _NAME.fullmatch(name)
        if found is None or found[1] not in cameras:
            expected = f"img_NUMBER_CAMERA_TIMEus.jpg with a camera of {', '.join(cameras)}"
            raise refuse("archive.content", field=str(source), expected=expected, got=name)
        key = int(found[2]), found[1]
        images.append(FileRecord(*key, name))
        if name in poses:
            trajectories[key] = poses[name]
    check_photos(root, [image.path for image in images])
    return Dataset(
        root=root,
        sensors={key: Sensor.with_camera(key, camera) for key, camera in cameras.items()},
        rigs={},
        trajectories=trajectories,
        images=tuple(images),
        depth_maps=(),
        gnss=(),
    )
