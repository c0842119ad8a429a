"""COLMAP's databases: cameras, keypoints, descriptors and priors, read through pycolmap."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image  # noqa: F401  Pillow saves PNGs only when it was imported before pycolmap
import pycolmap
from numpy.typing import NDArray

from visloc.errors import refuse

# pycolmap raises these on files that it cannot read, as damaging files showed.
REFUSALS = (ValueError, RuntimeError, IndexError, KeyError, MemoryError, OSError)
_SQLITE = b"SQLite format 3\0"


@dataclass(frozen=True, slots=True, eq=False)
class DatabaseImage:
    """One image of a database."""

    camera: int
    frame: tuple[str, int]
    keypoints: NDArray[np.float32] | None
    descriptors: NDArray[Any] | None
    fix: tuple[float, float, float] | None  # longitude, latitude in degrees, altitude in metres


@dataclass(frozen=True, slots=True, eq=False)
class Database:
    """The content of a database. Descriptors that are not SIFT are left out."""

    path: Path
    cameras: Mapping[int, pycolmap.Camera]
    images: Mapping[str, DatabaseImage]
    keypoints_type: str
    notes: tuple[str, ...]


def read_database(path: Path) -> Database:
    """Read a database."""
    try:
        with path.open("rb") as file:
            is_database = file.read(len(_SQLITE)) == _SQLITE
    except OSError as error:
        raise refuse("import.unreadable", field=str(path), got=error.strerror) from error
    if not is_database:
        raise refuse(
            "import.colmap",
            "the file is not a COLMAP database",
            field=str(path),
            expected="an SQLite file",
        )
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "database.db"  # pycolmap migrates old databases in place
        shutil.copyfile(path, copy)
        journal = path.with_name(path.name + "-wal")  # where COLMAP's last writes may still be
        if journal.is_file():
            shutil.copyfile(journal, copy.with_name(copy.name + "-wal"))
        try:
            database = pycolmap.Database.open(copy)
            try:
                return _contents(path, database)
            finally:
                database.close()
        except REFUSALS as error:
            raise refuse(
                "import.colmap",
                "the file is not a COLMAP database, or it is damaged",
                field=str(path),
                got=str(error),
            ) from error


def _contents(path: Path, database: pycolmap.Database) -> Database:
    cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
    frames = {
        data.id: frame.frame_id
        for frame in database.read_all_frames()
        for data in frame.data_ids
        if data.sensor_id.type == pycolmap.SensorType.CAMERA
    }
    fixes, notes = _fixes(database)
    images: dict[str, DatabaseImage] = {}
    kinds: set[str] = set()
    for image in database.read_all_images():
        if image.camera_id not in cameras:
            raise refuse(
                "import.colmap",
                f"the database does not have the camera of image {image.name!r}",
                field=str(path),
                expected=map(str, sorted(cameras)[:10]),
                got=image.camera_id,
            )
        key = image.image_id
        keypoints = (
            np.array(database.read_keypoints(key)) if database.exists_keypoints(key) else None
        )
        descriptors = None
        if keypoints is not None and database.exists_descriptors(key):
            found = database.read_descriptors(key)
            kinds.add(found.type.name)
            # Other types are floating point numbers in the same bytes, how is not documented.
            if found.type == pycolmap.FeatureExtractorType.SIFT:
                descriptors = np.array(found.data)
        frame = ("frame", frames[key]) if key in frames else ("image", key)
        images[image.name] = DatabaseImage(
            image.camera_id, frame, keypoints, descriptors, fixes.get(key)
        )
    others = sorted(kinds - {"SIFT"})
    if others:
        notes.append(f"descriptors of type {', '.join(others)} were left out: only SIFT is read")
    kind = kinds.pop().lower() if len(kinds) == 1 else "colmap"
    return Database(path, cameras, images, kind, tuple(notes))


def _fixes(
    database: pycolmap.Database,
) -> tuple[dict[int, tuple[float, float, float]], list[str]]:
    """Return the priors of positions on Earth by image id."""
    fixes: dict[int, tuple[float, float, float]] = {}
    num_others = 0
    for prior in database.read_all_pose_priors():
        if prior.corr_data_id.sensor_id.type != pycolmap.SensorType.CAMERA:
            continue
        latitude, longitude, altitude = map(float, prior.position.ravel())
        if (
            prior.coordinate_system != pycolmap.PosePriorCoordinateSystem.WGS84
            or not (abs(latitude) <= 90 and abs(longitude) <= 180)  # NaN is not
            or not np.isfinite(altitude)
        ):
            num_others += 1
        else:
            fixes[prior.corr_data_id.id] = (longitude, latitude, altitude)
    if not num_others:
        return fixes, []
    return fixes, [f"{num_others} pose priors that are not positions on Earth were left out"]
