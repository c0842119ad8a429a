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
from mapping.importers.reading.json_fields import JsonValue, notes_on_unread, read_json
from mapping.importers.reading.photo_names import photo_names, photo_size
from mapping.importers.reading.poses import rotation_from_matrix
from mapping.stages.depth import DEFAULT_DEPTH_SCALE, is_png_of_16_bits
from visloc.errors import DatasetError, InvalidInput, VislocError, refuse
from visloc.geometry import MAX_IMAGE_SIDE, Camera, Pose
from visloc.kapture import Sensor

UNKNOWN_UNIT = (
    "nothing says that a unit of the world is a metre: it is if a recorder with ARKit, ARCore or "
    "lidar gave the poses, and is not if they came from COLMAP"
)
_FILE = "transforms.json"
_SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG")
_OURS_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])
_PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV")
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_UNITS = ("depth_unit_scale_factor", "integer_depth_scale")  # nerfstudio's key, instant-ngp's
_SAME_FOCAL = 0.01  # relative; angles and sizes are written with few digits
_NAMED = 3


@dataclass(slots=True)
class _Seen:
    """Values that frames share, gathered while they are read."""

    sensors: dict[str, Sensor] = field(default_factory=dict)
    cameras: dict[tuple[Camera, tuple[int, int] | None], str] = field(default_factory=dict)
    left_out: dict[str, list[str]] = field(default_factory=dict)

    def leave_out(self, why: str, name: str) -> None:
        self.left_out.setdefault(why, []).append(name)

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

    Masks, and depth maps that are 16-bit PNGs, go with their photos; depth is registered to them,
    maybe of another size. The world is metric if there are depth maps of nerfstudio's key, which
    are in metres by definition, and the file does not say that positions were scaled.

    Args:
        photos: folder that ``file_path`` is relative to; None takes that of the file.
    """
    file = path / _FILE if path.is_dir() else path
    return read_recording(read_json(file), file.parent if photos is None else photos)


def read_recording(top: JsonValue, folder: Path) -> ImportedModel:
    """Read the content of a ``transforms.json``, as ``read``."""
    file = top.file
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
    depth_scale = _depth_scale(top)
    notes, is_scaled = _notes(top)
    notes += name_notes
    notes += [
        f"{len(names)} {why}: {', '.join(names[:_NAMED])}" + (", ..." if names[_NAMED:] else "")
        for why, names in seen.left_out.items()
    ]
    in_metres = any(frame.get_set("depth_file_path") is not None for frame in frames)
    metric = with_depth and in_metres and not is_scaled
    if not metric:
        notes.append(UNKNOWN_UNIT)
    return ImportedModel(
        sensors=seen.sensors,
        images=images,
        photos=folder,
        points=np.empty((0, 3)),
        colors=np.empty((0, 3), np.uint8),
        observations=np.empty((0, 3), np.int64),
        metric=metric,
        depth_scale=depth_scale,
        notes=(*notes, *notes_on_unread(top)),
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
    camera = _camera(top, frame, name, folder, seen)
    value = frame.get_set("depth_file_path") or frame.get_set("depth_path")  # instant-ngp's
    depth = _file_beside(value, "depth maps", base, folder, seen)
    if depth is not None and not is_png_of_16_bits(folder / depth):
        seen.leave_out("depth maps are not 16-bit grey PNGs and left out", depth)
        depth = None
    depth_size = None if depth is None else photo_size(folder / depth)
    return ImportedImage(
        name=name,
        sensor=seen.sensor_of(camera, depth_size),
        timestamp=rank,
        cam_from_world=_pose(frame["transform_matrix"]),
        depth=depth,
        mask=_file_beside(frame.get_set("mask_path"), "masks", base, folder, seen),
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


def _camera(top: JsonValue, frame: JsonValue, name: str, folder: Path, seen: _Seen) -> Camera:
    def find(key: str) -> JsonValue | None:
        own, shared = frame.get_set(key), top.get_set(key)  # asked for both, so that both are read
        return own or shared

    def number(key: str) -> float | None:
        value = find(key)
        return None if value is None else value.number()

    def focal_length(axis: str, side: int) -> float | None:
        """Return what the file gives for an axis: pixels, or an angle over a side of the photo."""
        given = number(f"fl_{axis}")
        for key, in_radians in ((f"camera_angle_{axis}", float), (f"{axis}_fov", math.radians)):
            value = find(key)
            if value is None:
                continue
            angle = in_radians(value.number())
            if not 0 < angle < math.pi:
                raise value.error("the angle is not valid", expected="more than 0, less than pi")
            other = 0.5 * side / math.tan(0.5 * angle)
            given = other if given is None else given
            if abs(other - given) > _SAME_FOCAL * given:
                seen.leave_out(f"{key} contradict the focal length that was taken", name)
        return given

    size = _size(find("w"), find("h")) or photo_size(folder / name)
    if size is None:
        raise frame.error("neither the file nor a photo gives the image size", expected="w and h")
    width, height = size
    fx, fy = focal_length("x", width), focal_length("y", height)
    if fx is None:
        expected = "fl_x, camera_angle_x or x_fov"
        raise frame.error("the focal length is missing", expected=expected)
    cx, cy = number("cx"), number("cy")
    pinhole = (
        fx,
        fx if fy is None else fy,
        width / 2 if cx is None else cx,
        height / 2 if cy is None else cy,
    )
    model = find("camera_model")
    is_fisheye = find("is_fisheye")
    kind = "OPENCV" if model is None else model.text()
    if is_fisheye is not None and is_fisheye.flag():
        kind = "OPENCV_FISHEYE"
    k1, k2, k3, k4, p1, p2 = (number(key) or 0.0 for key in _DISTORTION)
    params: tuple[float, ...]
    if kind == "OPENCV_FISHEYE":
        if p1 or p2:
            raise frame.error("kapture cannot store p1 and p2 of a fisheye camera", expected="0")
        ours, params = kind, (*pinhole, k1, k2, k3, k4)
    elif kind not in _PERSPECTIVE:
        raise refuse(
            "camera.model",
            "kapture does not have this camera model",
            field=(model or frame).where,
            expected=(*_PERSPECTIVE, "OPENCV_FISHEYE"),
            got=kind,
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


def _file_beside(
    value: JsonValue | None, what: str, base: Path, folder: Path, seen: _Seen
) -> str | None:
    """Return the name of a photo's depth map or mask; None without such a file."""
    if value is None:
        return None
    (name,), shortened = photo_names([(value.text(), value.where)], base, folder)
    if shortened:
        why = f"names of {what} lead out of the folder; their last part was taken"
        seen.leave_out(why, value.text())
    if not _exists(folder / name):
        seen.leave_out(f"{what} are missing", name)
        return None
    return name


def _depth_scale(top: JsonValue) -> float:
    """Return how many metres, or units of the world, one unit of the depth maps is."""
    given = [value for key in _UNITS if (value := top.get_set(key)) is not None]
    for value in given:
        if not value.number() > 0:
            raise value.error("the unit of depth maps is not valid", expected="more than 0")
        if value.number() != given[0].number():
            raise value.error(f"the value contradicts {given[0].key}", expected="one unit")
    return given[0].number() if given else DEFAULT_DEPTH_SCALE


def _notes(top: JsonValue) -> tuple[list[str], bool]:
    """Return what the top says that is not kept, and whether positions were scaled."""
    notes = []
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
