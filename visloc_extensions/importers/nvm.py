"""VisualSFM's NVM files.

Format: VisualSFM's documentation, section "NVM file format", and what its files show. A file
holds models, each a list of cameras and a list of points, and ends with an empty one. A camera
line is

    name f  qw qx qy qz  Cx Cy Cz  k  0            (header NVM_V3)
    name f  r11 ... r33  tx ty tz  k  0            (header NVM_V3_R9T)

with x_cam = R (x_world - C), or R x_world + t; camera axes are ours. Measurements count from the
centre of the image, y down. The distortion is one of measurements: where r is the distance of
a measurement from the centre divided by f, the point was seen at r (1 + k r^2).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapping.importers.largest import ModelSize, largest_model
from mapping.importers.model import ImportedImage, ImportedModel
from mapping.importers.reading.photo_names import photo_names, photo_size
from mapping.importers.reading.poses import pose_from_center, rotation_from_matrix
from mapping.importers.reading.text_lines import TextLines
from visloc.errors import InvalidInput, refuse
from visloc.geometry import Camera, Pose
from visloc.kapture import Sensor
from visloc.kapture.dataset import UNKNOWN_CAMERA
from visloc_extensions.importers.centered import (
    kept_measurements,
    note_on_absent,
    with_measurements,
)
from visloc_extensions.importers.tracks import Measurements

_MAX_COUNT = 10**9
_MIN_FOCAL = 1e-3  # pixels; powers of what is below overflow in 1 / f


@dataclass(frozen=True, slots=True)
class _Calibration:
    """The camera that ``FixedK fx cx fy cy`` in the first line gives for all photos, in pixels."""

    fx: float
    cx: float
    fy: float
    cy: float


@dataclass(frozen=True, slots=True, eq=False)
class _CameraLine:
    line: int
    name: str
    focal: float
    pose: Pose
    k: float


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """One of the models of a file."""

    cameras: list[_CameraLine]
    points: list[list[float]]
    colors: list[list[int]]
    rows: list[tuple[int, int, int, float, float]]


def read(path: Path, photos: Path | None = None) -> ImportedModel:
    """Read the largest model of an NVM file.

    The format has no image sizes: they are read from the photos, and cameras without a photo are
    left out. Distortion becomes RADIAL, fitted to the inverse of the format's; the note says how
    well.

    Args:
        path: the file, or a folder with exactly one ``*.nvm``.
        photos: folder of photos; the file's folder by default.
    """
    path = _nvm_file(path)
    photos = path.parent if photos is None else photos
    with TextLines(path) as lines:
        fixed, has_matrices = _read_header(lines)
        parts = []
        while (part := _read_part(lines, has_matrices)) is not None:
            parts.append(part)
        rest = 0
        while (line := lines.next_or_none()) is not None:
            rest += line != "0" and not line.startswith("#")
    if not parts:
        raise refuse("import.empty", "the file holds no model", field=str(path))
    sizes = [
        ModelSize(f"model {number}", photos=len(part.cameras), points=len(part.points))
        for number, part in enumerate(parts)
    ]
    largest, notes = largest_model("the file", sizes)
    if rest:  # of point clouds in PLY files
        notes.append(f"{rest} lines after the models are not read")
    return _model(path, photos, parts[largest], fixed, notes)


def read_poses(path: Path) -> dict[str, Pose]:
    """Read ``cam_from_world`` by name from the first model of a file; its points are not read."""
    found: dict[str, Pose] = {}
    with TextLines(path) as lines:
        _, has_matrices = _read_header(lines)
        for _ in range(lines.to_integer(lines.next("the number of cameras"), _MAX_COUNT)):
            camera = _read_camera(lines, has_matrices)
            if camera.name in found:
                raise refuse("import.duplicate_image", field=f"{path}:{camera.line}")
            found[camera.name] = camera.pose
    if not found:
        raise refuse("import.empty", "the file holds no model", field=str(path))
    return found


def _nvm_file(path: Path) -> Path:
    if not path.is_dir():
        return path
    found = sorted(path.glob("*.nvm"))
    if len(found) != 1:
        raise refuse(
            "import.missing",
            "the folder does not hold exactly one NVM file; name the file",
            field=str(path),
            expected="one *.nvm",
            got=[file.name for file in found],
        )
    return found[0]


def _read_header(lines: TextLines) -> tuple[_Calibration | None, bool]:
    fields = lines.next("NVM_V3").split()
    if fields[0] not in ("NVM_V3", "NVM_V3_R9T"):
        raise lines.error("this is not an NVM file", expected="NVM_V3 or NVM_V3_R9T", got=fields[0])
    if len(fields) == 1:
        return None, fields[0] == "NVM_V3_R9T"
    if fields[1] != "FixedK" or len(fields) < 6:
        raise lines.error(
            "the calibration is unknown", expected="FixedK fx cx fy cy", got=" ".join(fields[1:])
        )
    fx, cx, fy, cy, *others = (lines.to_number(field) for field in fields[2:])
    if any(others):
        raise lines.error("the calibration has more than is read", expected="4 numbers", got=others)
    if min(fx, fy) < _MIN_FOCAL:
        raise lines.error(
            "the focal length is not valid", expected=f"at least {_MIN_FOCAL} px", got=[fx, fy]
        )
    return _Calibration(fx, cx, fy, cy), fields[0] == "NVM_V3_R9T"


def _read_part(lines: TextLines, has_matrices: bool) -> _Part | None:
    """Read the next model; None where an empty one, or the end of the file, ends the list."""
    line = lines.next_or_none()
    if line is None or not (num_cameras := lines.to_integer(line, _MAX_COUNT)):
        return None
    cameras = [_read_camera(lines, has_matrices) for _ in range(num_cameras)]
    num_points = lines.to_integer(lines.next("the number of points"), _MAX_COUNT)
    part = _Part(cameras, [], [], [])
    for point in range(num_points):
        _read_point(lines, point, part)
    return part


def _read_camera(lines: TextLines, has_matrices: bool) -> _CameraLine:
    num_numbers = 15 if has_matrices else 10
    name, *fields = lines.next("a camera").rsplit(None, num_numbers)
    if len(fields) != num_numbers:
        raise lines.error(
            "the line does not describe a camera",
            expected=f"a name and {num_numbers} numbers",
            got=len(fields),
        )
    focal, *numbers, k, end = (lines.to_number(field) for field in fields)
    if end:
        raise lines.error("the line goes on after the distortion", expected="0", got=end)
    if focal < _MIN_FOCAL:
        raise lines.error(
            "the focal length is not valid", expected=f"at least {_MIN_FOCAL} px", got=focal
        )
    if has_matrices:
        rotation = rotation_from_matrix(numbers[:9])
        if rotation is None:
            raise lines.error(
                "this is not a rotation", expected="an orthonormal matrix", got=numbers[:9]
            )
        pose = Pose(rotation, np.array(numbers[9:]))
    else:
        try:
            rotation = Pose.from_quaternion(numbers[:4], np.zeros(3)).rotation
        except InvalidInput as error:
            raise lines.error(
                "this is not a rotation", expected="a quaternion that is not zero", got=numbers[:4]
            ) from error
        pose = pose_from_center(rotation, np.array(numbers[4:]))
    # VisualSFM writes a blank in a name as a double quote; other tools quote the whole name.
    quoted = len(name) > 1 and name[0] == name[-1] == '"'
    plain = (name[1:-1] if quoted else name).replace('"', " ")
    return _CameraLine(lines.number, plain, focal, pose, k)


def _read_point(lines: TextLines, point: int, part: _Part) -> None:
    expected = "X Y Z R G B count, and image, feature, x, y of each measurement"
    fields = lines.next(expected).split()
    count = lines.to_integer(fields[6], _MAX_COUNT) if len(fields) >= 7 else -1
    if len(fields) != 7 + 4 * count:
        raise lines.error(
            "the line has the wrong number of fields",
            expected=expected if count < 0 else f"{7 + 4 * count}: {expected}",
            got=len(fields),
        )
    part.points.append([lines.to_number(field) for field in fields[:3]])
    part.colors.append([lines.to_integer(field, 255) for field in fields[3:6]])
    for start in range(7, len(fields), 4):
        image, feature, x, y = fields[start : start + 4]
        part.rows.append(
            (
                point,
                lines.to_integer(image, len(part.cameras) - 1),
                lines.to_integer(feature, _MAX_COUNT),
                lines.to_number(x),
                lines.to_number(y),
            )
        )


def _model(
    path: Path, photos: Path, part: _Part, fixed: _Calibration | None, notes: list[str]
) -> ImportedModel:
    named = [(camera.name, f"{path}:{camera.line}") for camera in part.cameras]
    names, name_notes = photo_names(named, path.parent, photos)
    notes += name_notes
    sizes = [photo_size(photos / name) for name in names]
    kept = [index for index, size in enumerate(sizes) if size is not None]
    notes += note_on_absent(path, photos, names, kept)

    sensors: dict[str, Sensor] = {}
    images: list[ImportedImage] = []
    centers: list[tuple[float, float]] = []
    worst_fit = 0.0
    undistortable: list[str] = []
    for index in kept:
        width, height = sizes[index] or (0, 0)
        line = part.cameras[index]
        calibration = fixed or _Calibration(line.focal, width / 2, line.focal, height / 2)
        camera_id = f"camera_{index}"
        try:
            made = _camera(calibration, line.k, width, height)
        except InvalidInput as error:
            raise refuse(
                "import.line", error.message, field=f"{path}:{line.line}", got=error.got
            ) from error
        if made is None:
            undistortable.append(names[index])
            params = (UNKNOWN_CAMERA, str(width), str(height))
            sensors[camera_id] = Sensor(camera_id, "", "camera", params, None)
        else:
            sensors[camera_id] = Sensor.with_camera(camera_id, made[0])
            worst_fit = max(worst_fit, made[1])
        images.append(ImportedImage(names[index], camera_id, index, line.pose))
        centers.append((calibration.cx, calibration.cy))
    if any(part.cameras[index].k for index in kept):
        notes.append(
            "NVM distorts measurements; RADIAL cameras were fitted to the inverse, "
            f"at most {worst_fit:.2g} px off within the photos"
        )
    if undistortable:
        notes.append(
            f"{len(undistortable)} cameras have a distortion that folds the photo over itself; "
            f"their intrinsics count as unknown: {', '.join(undistortable[:3])}"
        )
    measurements = kept_measurements(Measurements.from_rows(part.rows), kept, len(names))
    return with_measurements(
        path,
        ImportedModel(
            sensors,
            tuple(images),
            photos,
            np.array(part.points, np.float64).reshape(-1, 3),
            np.array(part.colors, np.uint8).reshape(-1, 3),
            keypoints_type="sift",
            notes=tuple(notes),
        ),
        measurements,
        np.array(centers).reshape(-1, 2),
    )


def _camera(
    calibration: _Calibration, k: float, width: int, height: int
) -> tuple[Camera, float] | None:
    """Return the camera and how far its distortion is off, in pixels, or None.

    NVM gives the undistorted radius of a measured one; ours is the other way round. RADIAL is
    fitted to it by least squares up to the corners of the photo. None if the distortion is not
    invertible there.
    """
    c = calibration
    if k == 0.0:
        return Camera("PINHOLE", width, height, (c.fx, c.fy, c.cx, c.cy)), 0.0
    farthest = math.hypot(max(c.cx, width - c.cx) / c.fx, max(c.cy, height - c.cy) / c.fy)
    measured = np.linspace(0.0, farthest, 101)[1:]
    if 1 + 3 * k * farthest**2 <= 0.1:  # the slope of r (1 + k r^2)
        return None
    ideal = measured * (1 + k * measured**2)
    basis = np.column_stack([ideal**3, ideal**5])
    scale = np.abs(basis).max(axis=0)
    solution = np.linalg.lstsq(basis / scale, measured - ideal, rcond=None)[0]
    k1, k2 = (float(value) for value in solution / scale)
    off = float(np.abs(basis @ [k1, k2] - (measured - ideal)).max() * max(c.fx, c.fy))
    if c.fx == c.fy:
        return Camera("RADIAL", width, height, (c.fx, c.cx, c.cy, k1, k2)), off
    return Camera("OPENCV", width, height, (c.fx, c.fy, c.cx, c.cy, k1, k2, 0.0, 0.0)), off
