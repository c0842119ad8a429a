"""OpenMVG's ``sfm_data.json``.

Format: openMVG's sfm_data_io_cereal and its camera classes, as its files show. cereal writes the
type of an object by name once, and by number from then on; of an object that is shared, the data
once. A pose has ``rotation`` and ``center``: x_cam = R (X - C). OpenMVG counts pixel centres from
0 (its SIFT and its undistortion both do), so that keypoints and principal points move by half a
pixel here.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapping.importers.model import ImportedImage, ImportedModel
from mapping.importers.reading.json_fields import JsonValue, notes_on_unread, read_json
from mapping.importers.reading.photo_names import photo_names
from mapping.importers.reading.poses import pose_from_center, rotation_from_matrix
from visloc.errors import DatasetError, InvalidInput, refuse
from visloc.geometry import MAX_IMAGE_SIDE, Camera, Pose
from visloc.kapture import Sensor
from visloc.kapture.dataset import UNKNOWN_CAMERA
from visloc_extensions.importers.regions import PIXELS, with_features
from visloc_extensions.importers.tracks import Measurements

_UNDEFINED = 2**32 - 1  # an id that refers to nothing
_FIRST_USE = 2**31  # set in cereal's numbers where the name or the data follow


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    at: JsonValue
    name: str
    width: int
    height: int
    intrinsic: int | None
    pose: int | None


def read(path: Path, photos: Path | None = None) -> ImportedModel:
    """Read an OpenMVG scene.

    Features are taken from ``.feat`` and ``.desc`` (SIFT) beside the file, in ``matches`` beside
    it or in ``matches`` beside its folder, if all photos have them there and the observations
    are found in them; else the observations become the keypoints.

    Args:
        photos: folder of photos; by default what the file names as ``root_path``, when it exists.
    """
    if path.is_dir():
        path = path / "sfm_data.json"
    top = read_json(path)
    root = path.parent / top["root_path"].text()
    found_photos = root if photos is None and _is_folder(root) else photos
    cameras, left_out = _read_intrinsics(top["intrinsics"])
    poses = _read_poses(top["extrinsics"])
    views, notes = _usable(_read_views(top["views"]), left_out)
    if not views:
        raise refuse(
            "import.empty",
            "the file holds no photo that can be used" + "".join(f"; {note}" for note in notes),
            field=str(path),
        )
    named = [(view.name, view.at.where) for view in views.values()]
    names, name_notes = photo_names(named, root, root if found_photos is None else found_photos)
    notes += name_notes

    sensors: dict[str, Sensor] = {}
    images: list[ImportedImage] = []
    for rank, (view, name) in enumerate(zip(views.values(), names, strict=True)):
        sensor = _sensor(view, cameras)
        sensors[sensor.id] = sensor
        pose = None if view.pose is None else poses.get(view.pose)
        images.append(ImportedImage(name, sensor.id, rank, pose))
    if num_lost := sum(image.cam_from_world is None for image in images):
        notes.append(f"{num_lost} of {len(images)} photos were not reconstructed")

    ranks = {key: rank for rank, key in enumerate(views)}
    points, measurements = _read_structure(top.get("structure"), ranks, top)
    stems = [Path(name).stem for name in names]
    keypoints_type, images, observations, feature_notes = with_features(
        path, stems, images, measurements
    )
    return ImportedModel(
        sensors,
        tuple(images),
        found_photos,
        points,
        np.zeros((len(points), 3), np.uint8),
        observations,
        keypoints_type=keypoints_type,
        notes=(*notes, *feature_notes, *notes_on_unread(top)),
    )


def _usable(
    views: dict[int, _View], left_out: Mapping[str, set[int]]
) -> tuple[dict[int, _View], list[str]]:
    """Leave out the views of cameras of unknown kinds; return the others, and notes."""
    notes = []
    for kind, ids in left_out.items():
        num = sum(view.intrinsic in ids for view in views.values())
        notes.append(f"{num} photos of a camera of the kind {kind!r} were left out")
    lost = set().union(*left_out.values())
    return {key: view for key, view in views.items() if view.intrinsic not in lost}, notes


def _is_folder(path: Path) -> bool:
    return os.path.isdir(path)  # noqa: PTH112 - Path.is_dir raises for names that cannot be


def _entries(array: JsonValue) -> dict[int, JsonValue]:
    """Return the values of an array of ``key`` and ``value``, by key."""
    entries: dict[int, JsonValue] = {}
    for element in array.elements():
        key = element["key"].integer(_UNDEFINED)
        if key in entries:
            raise element["key"].error("the key occurs twice", expected="different keys")
        entries[key] = element["value"]
    return entries


class _Pointers:
    """Follows cereal's shared pointers and polymorphic types within one array."""

    def __init__(self) -> None:
        self._data: dict[int, JsonValue] = {}
        self._types: dict[int, str] = {}

    def data(self, value: JsonValue) -> JsonValue:
        """Return what a ``ptr_wrapper`` points to."""
        wrapper = value["ptr_wrapper"]
        number = wrapper["id"].integer(2**32 - 1)
        if number >= _FIRST_USE:
            return self._data.setdefault(number - _FIRST_USE, wrapper["data"])
        if number not in self._data:
            raise wrapper["id"].error("the id refers to nothing before it")
        return self._data[number]

    def type_name(self, value: JsonValue) -> str:
        """Return the type of a polymorphic object."""
        number = value["polymorphic_id"].integer(2**32 - 1)
        if number >= _FIRST_USE:
            name = value["polymorphic_name"].text()
            return self._types.setdefault(number - _FIRST_USE, name)
        if number not in self._types:
            raise value["polymorphic_id"].error("the type was not named before")
        return self._types[number]


def _read_views(array: JsonValue) -> dict[int, _View]:
    pointers = _Pointers()
    views = {}
    for key, value in _entries(array).items():
        data = _flat(pointers.data(value))
        folder, file = data["local_path"].text(), data["filename"].text()
        intrinsic = data["id_intrinsic"].integer(_UNDEFINED)
        pose = data["id_pose"].integer(_UNDEFINED)
        views[key] = _View(
            data,
            f"{folder.rstrip('/')}/{file}" if folder else file,
            data["width"].integer(MAX_IMAGE_SIDE),
            data["height"].integer(MAX_IMAGE_SIDE),
            None if intrinsic == _UNDEFINED else intrinsic,
            None if pose == _UNDEFINED else pose,
        )
    return views


def _flat(data: JsonValue) -> JsonValue:
    """Return an object together with that of its base class, which some versions nest in it."""
    base = data.get("value0")
    if base is None or not isinstance(base.value, dict):
        return data
    own = {key: value for key, value in data.value.items() if key != "value0"}
    data.value.clear()  # in place, so that its fields are counted where they are read
    data.value.update(_flat(base).value | own)
    return data


def _read_intrinsics(array: JsonValue) -> tuple[dict[int, Camera], dict[str, set[int]]]:
    """Return the cameras by id, and by kind the ids of those that are not known here."""
    pointers = _Pointers()
    cameras: dict[int, Camera] = {}
    unknown: dict[str, set[int]] = {}
    for key, value in _entries(array).items():
        kind = pointers.type_name(value)
        data = _flat(pointers.data(value))
        try:
            camera = _camera(kind, data)
        except DatasetError:
            raise
        except InvalidInput as error:
            raise refuse(
                "import.json", error.message, field=data.where, expected=error.expected
            ) from error
        if camera is None:
            unknown.setdefault(kind, set()).add(key)
        else:
            cameras[key] = camera
    return cameras, unknown


def _camera(kind: str, data: JsonValue) -> Camera | None:
    distortion = {
        "pinhole": ("", 0),
        "pinhole_radial_k1": ("disto_k1", 1),
        "pinhole_radial_k3": ("disto_k3", 3),
        "pinhole_brown_t2": ("disto_t2", 5),
        "fisheye": ("fisheye", 4),
    }
    if kind not in distortion:
        return None
    width, height = data["width"].integer(MAX_IMAGE_SIDE), data["height"].integer(MAX_IMAGE_SIDE)
    f = data["focal_length"].number()
    cx, cy = (value + PIXELS.shift for value in data["principal_point"].numbers(2))
    field, count = distortion[kind]
    k = data[field].numbers(count) if field else []
    if kind == "fisheye":
        return Camera("OPENCV_FISHEYE", width, height, (f, f, cx, cy, *k))
    if not k:
        return Camera("SIMPLE_PINHOLE", width, height, (f, cx, cy))
    if len(k) == 1:
        return Camera("SIMPLE_RADIAL", width, height, (f, cx, cy, *k))
    # disto_t2 is k1 k2 k3 t1 t2, where t1 and t2 are OpenCV's p1 and p2. OpenCV's rational model
    # is the one that has a k3; its k4 to k6 are zero then.
    k1, k2, k3, p1, p2 = (*k, 0.0, 0.0)[:5]
    return Camera("FULL_OPENCV", width, height, (f, f, cx, cy, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0))


def _sensor(view: _View, cameras: dict[int, Camera]) -> Sensor:
    if not (view.width and view.height):
        raise view.at.error("the photo has no size", expected="width and height above 0")
    if view.intrinsic is None:
        sensor_id = f"unknown_{view.width}x{view.height}"
        params = (UNKNOWN_CAMERA, str(view.width), str(view.height))
        return Sensor(sensor_id, "", "camera", params, None)
    camera = cameras.get(view.intrinsic)
    if camera is None:
        raise view.at["id_intrinsic"].error(
            "there are no such intrinsics", expected="a key of intrinsics"
        )
    if (camera.width, camera.height) != (view.width, view.height):
        raise view.at.error(
            f"the photo has {view.width} x {view.height} pixels and its camera "
            f"{camera.width} x {camera.height}",
            expected="the same size",
        )
    return Sensor.with_camera(f"camera_{view.intrinsic}", camera)


def _read_poses(array: JsonValue) -> dict[int, Pose]:
    poses = {}
    for key, value in _entries(array).items():
        rows = value["rotation"]
        matrix = [row.numbers(3) for row in rows.elements()]
        rotation = rotation_from_matrix(matrix) if len(matrix) == 3 else None
        if rotation is None:
            raise rows.error("this is not a rotation", expected="an orthonormal matrix of 3 rows")
        poses[key] = pose_from_center(rotation, np.array(value["center"].numbers(3)))
    return poses


def _read_structure(
    array: JsonValue | None, ranks: dict[int, int], top: JsonValue
) -> tuple[NDArray[np.float64], Measurements]:
    """Return the points (P, 3) and where views of known cameras saw them, in our pixels."""
    known = set(_entries(top["views"]))
    points: list[list[float]] = []
    rows: list[tuple[int, int, int, float, float]] = []
    for value in _entries(array).values() if array is not None else ():
        for key, seen in _entries(value["observations"]).items():
            if key not in known:
                raise seen.error(f"the point is observed in view {key}, which does not exist")
            x, y = seen["x"].numbers(2)
            feature = seen["id_feat"].integer(_UNDEFINED)
            if key in ranks:
                rows.append((len(points), ranks[key], feature, x + PIXELS.shift, y + PIXELS.shift))
        points.append(value["X"].numbers(3))
    return np.array(points, np.float64).reshape(-1, 3), Measurements.from_rows(rows)
