"""COLMAP's models (text or binary, with or without rigs) and databases, read through pycolmap.

COLMAP's conventions of poses, cameras and pixels are ours. Photos have no timestamps: the rank of
the name takes their place, and photos of one rig frame share the rank of the first. On Windows,
names have backslashes.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import PIL.Image  # noqa: F401  Pillow saves PNGs only when it was imported before pycolmap
import pycolmap
from numpy.typing import NDArray

from mapping.importers.colmap_checks import check_model, has_model
from mapping.importers.colmap_database import REFUSALS, Database, DatabaseImage, read_database
from mapping.importers.largest import ModelSize, largest_model
from mapping.importers.model import ImportedImage, ImportedModel
from mapping.importers.reading.photo_names import natural_order, photo_names
from visloc.errors import DatasetError, InvalidInput, NotFound, VislocError, refuse
from visloc.geometry import CAMERA_MODELS, Camera, Pose
from visloc.kapture import GnssRecord, Sensor
from visloc.kapture.dataset import UNKNOWN_CAMERA

_GNSS = "gnss"
# A model's keypoints are the database's if they are this near: text models have few digits.
_SAME_PX = 0.05


def read(path: Path, photos: Path | None = None) -> ImportedModel:
    """Read a model, a database, or a model with the database that it was made of.

    Args:
        path: a folder with a model, or with models in subfolders of ``sparse``, in ``sparse`` or
            in subfolders of its own, of which the largest is taken; or a database; a folder with
            nothing but a ``database.db`` (or a single ``*.db``) is taken for that.
        photos: folder that names are relative to; None takes ``images`` in or beside ``path``.
    """
    folders = _model_folders(path)
    model, folder, notes = _largest(folders) if folders else (None, None, [])
    places = _places(path, folder)
    database_path = path if path.is_file() else _database_in(places)
    if folder is None and database_path is None:
        raise refuse(
            "import.missing",
            "there is neither a COLMAP model nor a COLMAP database",
            field=str(path),
            expected="cameras, images and points3D (.bin or .txt), there, in sparse/0, sparse or "
            "a subfolder; or a database.db",
            kind=NotFound,
        )
    if photos is None:
        photos = next((p / "images" for p in places if (p / "images").is_dir()), None)
    database = None if database_path is None else read_database(database_path)
    if model is not None and folder is not None:
        return _model(model, folder, database, photos, notes)
    assert database is not None
    return _model_of_database(database, photos)


def _model_folders(path: Path) -> list[Path]:
    """Return the folders with models in the first of the usual places that has any."""
    sparse = path / "sparse"
    places = ([path], _subfolders(sparse), [sparse], _subfolders(path))
    return next((found for place in places if (found := [f for f in place if has_model(f)])), [])


def _subfolders(path: Path) -> list[Path]:
    return sorted(path.iterdir()) if path.is_dir() else []


def _largest(folders: list[Path]) -> tuple[pycolmap.Reconstruction, Path, list[str]]:
    """Read the models of one place; a damaged one is left out with a note if there is another."""
    models: list[tuple[pycolmap.Reconstruction, Path]] = []
    damaged: list[VislocError] = []
    for folder in folders:
        try:
            models.append((_reconstruction(folder), folder))
        except VislocError as error:
            damaged.append(error)
    if not models:
        raise damaged[0]
    sizes = [
        ModelSize(folder.name, photos=model.num_reg_images(), points=model.num_points3D())
        for model, folder in models
    ]
    row, notes = largest_model(str(folders[0].parent), sizes)
    return *models[row], [*notes, *(f"a model was left out: {error}" for error in damaged)]


def _places(path: Path, folder: Path | None) -> list[Path]:
    """Return where the photos and the database of a model may be; of a database, its folder."""
    if folder is None:
        return [path if path.is_dir() else path.parent]
    folder = folder.absolute()
    places = [folder, folder.parent]
    if folder.parent.name == "sparse":
        places.append(folder.parent.parent)
    return places


def _database_in(places: Iterable[Path]) -> Path | None:
    for place in places:
        if (place / "database.db").is_file():
            return place / "database.db"
        found = sorted(place.glob("*.db"))
        if len(found) == 1:
            return found[0]
    return None


def _reconstruction(folder: Path) -> pycolmap.Reconstruction:
    with tempfile.TemporaryDirectory() as scratch:
        names = check_model(folder, Path(scratch))
        try:
            model = pycolmap.Reconstruction(folder if names is None else scratch)
            for image, name in (names or {}).items():
                model.images[image].name = name
        except REFUSALS as error:
            raise refuse(
                "import.colmap",
                "the COLMAP model is damaged or not a COLMAP model",
                field=str(folder),
                expected="files that belong together",
                got=str(error),
            ) from error
    return model


def _model(
    model: pycolmap.Reconstruction,
    folder: Path,
    database: Database | None,
    photos: Path | None,
    notes: list[str],
) -> ImportedModel:
    colmap_images = sorted(model.images.values(), key=lambda image: natural_order(image.name))
    rows = {image.image_id: row for row, image in enumerate(colmap_images)}
    keypoints = [_points2d(image) for image in colmap_images]
    names = [image.name for image in colmap_images]
    known: Mapping[str, DatabaseImage] = {}
    keypoints_type = "colmap"
    if database is not None and _belongs(database, names, keypoints, notes):
        known, keypoints_type = database.images, database.keypoints_type
        notes += database.notes
    timestamps = _timestamps([(image.name, image.frame_id) for image in colmap_images])
    paths = _paths(names, folder, photos, notes)
    with_keypoints = any(map(len, keypoints))
    images = tuple(
        ImportedImage(
            name=paths[image.name],
            sensor=_sensor_id(image.camera_id),
            timestamp=timestamps[image.name],
            cam_from_world=_pose(image, folder),
            keypoints=known[image.name].keypoints if known else (own if with_keypoints else None),
            descriptors=known[image.name].descriptors if known else None,
        )
        for image, own in zip(colmap_images, keypoints, strict=True)
    )
    num_rigs = sum(rig.num_sensors() > 1 for rig in model.rigs.values())
    if num_rigs:
        notes.append(
            f"{num_rigs} rigs of several cameras: every photo has its own pose, the rigs "
            "themselves are left out"
        )
    points, colors, observations = _points(model, rows)
    users = {image.camera_id: image.name for image in colmap_images}
    sensors = _sensors(dict(model.cameras.items()), users, folder, notes)
    gnss = _gnss(known, timestamps)
    return ImportedModel(
        sensors=sensors | _gnss_sensors(gnss),
        images=images,
        photos=photos,
        points=points,
        colors=colors,
        observations=observations,
        keypoints_type=keypoints_type,
        gnss=gnss,
        notes=tuple(notes),
    )


def _model_of_database(database: Database, photos: Path | None) -> ImportedModel:
    names = sorted(database.images, key=natural_order)
    timestamps = _timestamps([(name, database.images[name].frame) for name in names])
    users = {database.images[name].camera: name for name in names}
    notes = [*database.notes, "a database has no poses: mapping build --poses estimate finds them"]
    paths = _paths(names, database.path, photos, notes)
    sensors = _sensors(database.cameras, users, database.path, notes)
    guessed = []
    for key, camera in sorted(database.cameras.items()):
        sensor = sensors.get(_sensor_id(key))
        if sensor is not None and not camera.has_prior_focal_length:
            guessed.append(str(key))
            size = (UNKNOWN_CAMERA, str(camera.width), str(camera.height))
            sensors[sensor.id] = Sensor(sensor.id, sensor.name, sensor.kind, size, None)
    if guessed:
        notes.append(
            f"{len(guessed)} cameras have a focal length that COLMAP guessed, and become cameras "
            f"of unknown intrinsics: {', '.join(guessed[:3])}" + (", ..." if guessed[3:] else "")
        )
    gnss = _gnss(database.images, timestamps)
    return ImportedModel(
        sensors=sensors | _gnss_sensors(gnss),
        images=tuple(
            ImportedImage(
                name=paths[name],
                sensor=_sensor_id(database.images[name].camera),
                timestamp=timestamps[name],
                cam_from_world=None,
                keypoints=database.images[name].keypoints,
                descriptors=database.images[name].descriptors,
            )
            for name in names
        ),
        photos=photos,
        points=np.empty((0, 3)),
        colors=np.empty((0, 3), np.uint8),
        observations=np.empty((0, 3), np.int64),
        keypoints_type=database.keypoints_type,
        gnss=gnss,
        notes=tuple(notes),
    )


def _paths(names: list[str], source: Path, photos: Path | None, notes: list[str]) -> dict[str, str]:
    """Return where each photo lies in the folder of photos: names may be those of Windows."""
    folder = source if photos is None else photos
    paths, more = photo_names(
        [(name, f"{source}: image {name!r}") for name in names], folder, folder
    )
    notes += more
    return dict(zip(names, paths, strict=True))


def _belongs(
    database: Database,
    names: list[str],
    keypoints: list[NDArray[np.float32]],
    notes: list[str],
) -> bool:
    """Tell whether a database has the model's keypoints, row by row."""
    for name, own in zip(names, keypoints, strict=True):
        image = database.images.get(name)
        other = None if image is None else image.keypoints
        if (
            other is None
            or len(other) != len(own)
            or np.abs(other[:, :2] - own).max(initial=0.0) > _SAME_PX
        ):
            notes.append(
                f"{database.path.name} was not used: it does not have the keypoints of {name!r} "
                "as the model has them"
            )
            return False
    if len(database.images) > len(names):
        notes.append(
            f"{len(database.images) - len(names)} images of {database.path.name} are not in the "
            "model and left out"
        )
    return True


def _points2d(image: pycolmap.Image) -> NDArray[np.float32]:
    return np.array([point.xy for point in image.points2D], np.float32).reshape(-1, 2)


def _points(
    model: pycolmap.Reconstruction, rows: Mapping[int, int]
) -> tuple[NDArray[np.float64], NDArray[np.uint8], NDArray[np.int64]]:
    """Return points in the order of their ids, colours, and observations."""
    ordered = [model.points3D[key] for key in sorted(model.points3D)]
    observations = [
        (index, rows[element.image_id], element.point2D_idx)
        for index, point in enumerate(ordered)
        for element in point.track.elements
    ]
    return (
        np.array([point.xyz for point in ordered], np.float64).reshape(-1, 3),
        np.array([point.color for point in ordered], np.uint8).reshape(-1, 3),
        np.array(observations, np.int64).reshape(-1, 3),
    )


def _pose(image: pycolmap.Image, folder: Path) -> Pose | None:
    if not image.has_pose:
        return None
    rigid = image.cam_from_world()
    x, y, z, w = rigid.rotation.quat
    try:
        return Pose.from_quaternion((w, x, y, z), rigid.translation)
    except InvalidInput as error:
        raise error.about(f"{folder}: image {image.name!r}", DatasetError) from error


def _sensor_id(camera_id: int) -> str:
    return f"camera{camera_id}"


def _sensors(
    cameras: Mapping[int, pycolmap.Camera], users: Mapping[int, str], source: Path, notes: list[str]
) -> dict[str, Sensor]:
    """Return the sensors by id; those that no photo needs are left out where they cannot be had."""
    sensors = {}
    for key, camera in sorted(cameras.items()):
        try:
            sensor = _sensor(camera, source, users.get(key))
        except DatasetError as error:
            if key in users:
                raise
            notes.append(f"a camera that no photo has was left out: {error}")
        else:
            sensors[sensor.id] = sensor
    return sensors


def _sensor(camera: pycolmap.Camera, source: Path, image: str | None) -> Sensor:
    where = f"{source}: camera {camera.camera_id}" + ("" if image is None else f" of {image!r}")
    model = camera.model.name
    if model not in CAMERA_MODELS:
        raise refuse(
            "camera.model",
            "kapture does not have this camera model; undistort the images in COLMAP "
            "first, or estimate with another model",
            field=where,
            expected=CAMERA_MODELS,
            got=model,
            kind=DatasetError,
        )
    try:
        return Sensor.with_camera(
            _sensor_id(camera.camera_id),
            Camera(model, camera.width, camera.height, tuple(map(float, camera.params))),
        )
    except InvalidInput as error:
        raise error.about(where, DatasetError) from error


def _timestamps(frames: Iterable[tuple[str, object]]) -> dict[str, int]:
    """Return the rank of each image, given in order with their frames."""
    ranks: dict[object, int] = {}
    return {name: ranks.setdefault(frame, len(ranks)) for name, frame in frames}


def _gnss(
    images: Mapping[str, DatabaseImage], timestamps: Mapping[str, int]
) -> tuple[GnssRecord, ...]:
    fixes: dict[int, GnssRecord] = {}
    for name, timestamp in timestamps.items():
        fix = images[name].fix if name in images else None
        if fix is not None:  # of the images of one frame, the first
            fixes.setdefault(timestamp, GnssRecord(timestamp, _GNSS, *fix, utc=0.0, dop=0.0))
    return tuple(fixes.values())


def _gnss_sensors(gnss: tuple[GnssRecord, ...]) -> dict[str, Sensor]:
    return {_GNSS: Sensor(_GNSS, "", "gnss", ("EPSG:4326",), None)} if gnss else {}
