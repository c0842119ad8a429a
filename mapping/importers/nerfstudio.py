"""nerfstudio's ``transforms.json``, as Polycam, Record3D, ARKit and ARCore recorders export it.

Format: nerfstudio's documentation, "Data conventions", and instant-ngp's, which it extends.
``transform_matrix`` is camera to world, the camera looking along -z with y up (OpenGL); ours looks
along z with y down. Pixel centres lie at +0.5, so that principal points are ours as they are.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from mapping.importers.dataset import depth_sensor_id
from mapping.importers.model import ImportedImage, ImportedModel
from mapping.importers.reading.json_fields import JsonValue, read_json
from mapping.importers.reading.photo_names import photo_names, photo_size
from mapping.importers.reading.tracks import rotation_from_matrix
from mapping.stages.depth import DEFAULT_DEPTH_SCALE
from visloc.errors import DatasetError, InvalidInput, VislocError, refuse
from visloc.geometry import MAX_IMAGE_SIDE, Camera, Pose
from visloc.kapture import Sensor

_FILE = "transforms.json"
_SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG")
_OURS_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])
_PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV")
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_NAMED = 3


@dataclass(slots=True)
class _Seen:
    """Values that frames share, gathered while they are read."""

    sensors: dict[str, Sensor] = field(default_factory=dict)
    cameras: dict[tuple[Camera, tuple[int, int] | None], str] = field(default_factory=dict)
    left_out: dict[str, list[str]] = field(default_factory=dict)

    def sensor_of(self, camera: Camera, depth_size: tuple[int, int] | None) -> str:
        """Return the id of the sensor of a photo, made if it is new, with its depth sensor."""
        key = camera, depth_size
        if key not in self.cameras:
            sensor = f"camera{len(self.cameras) + 1}"
            self.cameras[key] = sensor
            self.sensors[sensor] = Sensor.with_camera(sensor, camera)
            if depth_size is not None:
                depth = depth_sensor_id(sensor)
                self.sensors[depth] = Sensor.with_camera(depth, camera.scaled(*depth_size), "depth")
        return self.cameras[key]


def read(path: Path, photos: Path | None = None) -> ImportedModel:
    """Read a ``transforms.json``.

    Depth maps that are 16-bit PNGs go with their photos; they are registered to them, maybe of
    another size. The world is metric if there are such depth maps, which are in metres by
    definition, and the file does not say that positions were scaled.

    Args:
        path: the file, or the folder that holds it.
        photos: folder that ``file_path`` is relative to; None takes that of the file.

    Raises:
        DatasetError: ``import.missing``, ``import.json``, ``import.photo_name`` or ``camera.*``,
            with the file and the frame.
    """
    file = path / _FILE if path.is_dir() else path
    top = read_json(file)
    folder = file.parent if photos is None else photos
    frames = top["frames"].elements()
    paths = [frame["file_path"] for frame in frames]
    raw = [(path.text(), path.where) for path in paths]
    names, name_notes = photo_names(raw, file.parent, folder)
    seen = _Seen()
    images = tuple(
        _image(top, frame, _with_suffix(name, folder), rank, file.parent, folder, seen)
        for rank, (frame, name) in enumerate(zip(frames, names, strict=True))
    )
    with_depth = any(image.depth is not None for image in images)
    notes, is_scaled = _notes(top, with_depth)
    notes += name_notes
    notes += [
        f"{len(names)} {why}: {', '.join(names[:_NAMED])}" + (", ..." if names[_NAMED:] else "")
        for why, names in seen.left_out.items()
    ]
    metric = with_depth and not is_scaled
    if not metric:
        notes.append(
            "nothing says that a unit of the world is a metre: it is if a recorder with ARKit, "
            "ARCore or lidar gave the poses, and is not if they came from COLMAP"
        )
    return ImportedModel(
        sensors=seen.sensors,
        images=images,
        photos=folder,
        points=np.empty((0, 3)),
        colors=np.empty((0, 3), np.uint8),
        observations=np.empty((0, 3), np.int64),
        metric=metric,
        notes=tuple(notes),
    )


def _image(
    top: JsonValue,
    frame: JsonValue,
    name: str,
    rank: int,
    base: Path,
    folder: Path,
    seen: _Seen,
) -> ImportedImage:
    camera = _camera(top, frame, folder / name)
    depth, depth_size = _depth(frame, base, folder, seen)
    return ImportedImage(
        name=name,
        sensor=seen.sensor_of(camera, depth_size),
        timestamp=rank,
        cam_from_world=_pose(frame["transform_matrix"]),
        depth=depth,
    )


def _with_suffix(name: str, folder: Path) -> str:
    # The synthetic scenes of NeRF name photos without their suffix.
    if PurePosixPath(name).suffix.lower() not in (s.lower() for s in _SUFFIXES):
        for suffix in _SUFFIXES:
            if _exists(folder / (name + suffix)):
                return name + suffix
    return name


def _exists(path: Path) -> bool:
    return os.path.isfile(path)  # noqa: PTH113 - Path.is_file raises for too long names


def _pose(value: JsonValue) -> Pose:
    rows = [row.numbers(4) for row in value.elements()]
    if len(rows) not in (3, 4) or rows[3:] not in ([], [[0, 0, 0, 1]]):
        raise value.error(
            "the matrix is not a pose",
            expected="a rotation and a position, camera to world: 3 or 4 rows of 4",
        )
    matrix = np.array(rows, np.float64)
    rotation = rotation_from_matrix(matrix[:3, :3])
    if rotation is None:
        raise _no_rotation(matrix[:3, :3], value)
    cam_from_world = _OURS_FROM_OPENGL @ rotation.T
    return Pose(cam_from_world, -cam_from_world @ matrix[:3, 3])


def _no_rotation(matrix: NDArray[np.float64], value: JsonValue) -> VislocError:
    """Say what is wrong with the left three columns of a transform."""
    lengths = np.linalg.norm(matrix, axis=0)
    determinant = float(np.linalg.det(matrix))
    scale = abs(determinant) ** (1 / 3)
    shown = ", ".join(f"{length:.6g}" for length in lengths)
    if determinant < 0:
        message = "the pose is mirrored: its frame is left-handed; negate one axis of the frame"
    elif scale > 0 and rotation_from_matrix(matrix / scale) is not None:
        message = f"the pose is scaled by {scale:.6g}; divide its first three columns by that"
    else:
        message = "the first three columns of the pose are not a rotation"
    return refuse(
        "import.json",
        message,
        field=value.where,
        expected="three columns of length 1 at right angles, with determinant 1",
        got=f"columns of length {shown} and determinant {determinant:.6g}",
    )


def _camera(top: JsonValue, frame: JsonValue, photo: Path) -> Camera:
    def find(key: str) -> JsonValue | None:
        return frame.get(key) or top.get(key)

    def number(key: str) -> float | None:
        value = find(key)
        return None if value is None else value.number()

    size = _size(find("w"), find("h")) or photo_size(photo)
    if size is None:
        raise frame.error("neither the file nor a photo gives the image size", expected="w and h")
    width, height = size
    focal = number("fl_x")
    angle = number("camera_angle_x")
    if focal is None and angle is not None and 0 < angle < math.pi:
        focal = 0.5 * width / math.tan(0.5 * angle)
    if focal is None:
        raise frame.error("the focal length is missing", expected="fl_x or camera_angle_x")
    fy, cx, cy = number("fl_y"), number("cx"), number("cy")
    pinhole = (
        focal,
        focal if fy is None else fy,
        width / 2 if cx is None else cx,
        height / 2 if cy is None else cy,
    )
    model = find("camera_model")
    is_fisheye = find("is_fisheye")
    name = "OPENCV" if model is None else model.text()
    if is_fisheye is not None and is_fisheye.value is True:
        name = "OPENCV_FISHEYE"
    k1, k2, k3, k4, p1, p2 = (number(key) or 0.0 for key in _DISTORTION)
    params: tuple[float, ...]
    if name == "OPENCV_FISHEYE":
        ours, params = name, (*pinhole, k1, k2, k3, k4)
    elif name not in _PERSPECTIVE:
        raise refuse(
            "camera.model",
            "kapture does not have this camera model",
            field=(model or frame).where,
            expected=(*_PERSPECTIVE, "OPENCV_FISHEYE"),
            got=name,
            kind=DatasetError,
        )
    elif k4:
        raise frame.error("kapture cannot store k4 of a perspective camera", expected="0")
    elif k3:
        ours, params = "FULL_OPENCV", (*pinhole, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)
    elif k1 or k2 or p1 or p2:
        ours, params = "OPENCV", (*pinhole, k1, k2, p1, p2)
    else:
        ours, params = "PINHOLE", pinhole
    try:
        return Camera(ours, width, height, params)
    except InvalidInput as error:
        raise error.about(frame.where, DatasetError) from error


def _size(width: JsonValue | None, height: JsonValue | None) -> tuple[int, int] | None:
    if width is None or height is None:
        return None
    sides = []
    for value in (width, height):
        side = value.number()  # some recorders write 1920.0
        if not (side.is_integer() and 1 <= side <= MAX_IMAGE_SIDE):
            raise value.error(
                "this is not a valid size", expected=f"1 to {MAX_IMAGE_SIDE} whole pixels"
            )
        sides.append(int(side))
    return sides[0], sides[1]


def _depth(
    frame: JsonValue, base: Path, folder: Path, seen: _Seen
) -> tuple[str | None, tuple[int, int] | None]:
    """Return the depth map of a frame and its size; None for both without a usable one."""
    value = frame.get("depth_file_path")
    if value is None or value.value is None:
        return None, None
    (name,), shortened = photo_names([(value.text(), value.where)], base, folder)
    if shortened:
        seen.left_out.setdefault(
            "names of depth maps lead out of the folder; their last part was taken", []
        ).append(value.text())
    if PurePosixPath(name).suffix.lower() != ".png":
        seen.left_out.setdefault("depth maps are not PNGs and left out", []).append(name)
        return None, None
    size = photo_size(folder / name)
    if size is None:
        seen.left_out.setdefault("depth maps are missing", []).append(name)
        return None, None
    return name, size


def _notes(top: JsonValue, with_depth: bool) -> tuple[list[str], bool]:
    """Return what the top says that is not kept, and whether positions were scaled."""
    notes = []
    scale = top.get("depth_unit_scale_factor")
    if with_depth and scale is not None and scale.number() != DEFAULT_DEPTH_SCALE:
        notes.append(
            f"the unit of depth maps is {scale.number():g} m: build with "
            f"--depth-scale {scale.number():g}"
        )
    if top.get("applied_transform") is not None:
        notes.append(
            "applied_transform is left out: positions are as in the file, after that transform"
        )
    applied = top.get("applied_scale")
    is_scaled = applied is not None and applied.number() != 1
    if applied is not None and is_scaled:
        notes.append(
            f"applied_scale is {applied.number():g}: positions are as in the file, not in metres"
        )
    if top.get("ply_file_path") is not None:
        notes.append("ply_file_path is left out: its points do not tell which photos see them")
    return notes, is_scaled
