"""Aachen Day-Night, and its version 1.1.

Layout after the README of the archives (visuallocalization.net): photos in ``images_upright/``,
``3D-models/aachen_cvpr2018_db.nvm`` with the poses of the database photos, and
``3D-models/database_intrinsics.txt`` with their cameras, which count instead of those of the NVM
file. ``queries/`` has a list with cameras for day and one for night. Names include the subfolders:
``db/1.jpg``, ``query/night/nexus5x/IMG_1.jpg``. The model of version 1.1 is COLMAP's, in
``3D-models/aachen_v_1_1``, where hloc's ``pipelines/Aachen_v1_1`` reads it too.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from mapping.importers import colmap
from visloc.errors import refuse
from visloc.kapture import Dataset, FileRecord
from visloc_extensions.importers import nvm
from visloc_extensions.research.datasets.photo_lists import (
    check_photos,
    read_cameras,
    with_own_cameras,
)

_MODELS, _QUERIES = "3D-models", "queries"
_LISTS = ("day_time_queries_with_intrinsics.txt", "night_time_queries_with_intrinsics.txt")
# hloc unpacks the photos into the second one.
_PHOTOS = ("images_upright", "images/images_upright")


def read_aachen(folder: Path) -> Mapping[str, Dataset]:
    """Read database and query photos of the first version."""
    model = folder / _MODELS / "aachen_cvpr2018_db.nvm"
    if not model.is_file():
        raise refuse("archive.missing", field=str(model), expected="the model of VisualSFM")
    intrinsics = folder / _MODELS / "database_intrinsics.txt"
    cameras, poses = read_cameras(intrinsics), nvm.read_poses(model)
    for name in poses:
        if name not in cameras:
            raise refuse("archive.content", field=str(intrinsics), expected=f"camera of {name}")
    root = _photos_of(folder)
    posed = {name: cameras[name] for name in poses}
    return {"mapping": with_own_cameras(root, posed, poses), "query": _queries(folder, root)}


def read_aachen_v1_1(folder: Path) -> Mapping[str, Dataset]:
    """Read database and query photos of version 1.1; raises as ``read_aachen``."""
    model, root = folder / _MODELS / "aachen_v_1_1", _photos_of(folder)
    if not model.is_dir():
        raise refuse("archive.missing", field=str(model), expected="the model of COLMAP")
    read = colmap.read(model, root)
    check_photos(root, [image.name for image in read.images])
    mapping = Dataset(
        root=root,
        sensors=read.sensors,
        rigs={},
        trajectories={
            (image.timestamp, image.sensor): image.cam_from_world
            for image in read.images
            if image.cam_from_world is not None
        },
        images=tuple(FileRecord(i.timestamp, i.sensor, i.name) for i in read.images),
        depth_maps=(),
        gnss=(),
    )
    return {"mapping": mapping, "query": _queries(folder, root)}


def _photos_of(folder: Path) -> Path:
    for name in _PHOTOS:
        if (folder / name).is_dir():
            return folder / name
    expected = "the photos of database_and_query_images.zip"
    raise refuse("archive.missing", field=str(folder / _PHOTOS[0]), expected=expected)


def _queries(folder: Path, root: Path) -> Dataset:
    cameras = {}
    for name in _LISTS:
        cameras.update(read_cameras(folder / _QUERIES / name))
    return with_own_cameras(root, cameras, {})
