"""Bundler's output: ``bundle.out`` and its list of photos.

Format: Bundler v0.4 User's Manual, section "Output format and scene representation". Per camera
f k1 k2, a rotation R and a translation t with x_cam = R x_world + t, where the camera looks
along -z with y up; a point projects to

    p = -(x, y) / z,    f (1 + k1 |p|^2 + k2 |p|^4) p,

counted from the centre of the image with y up. Cameras that were not reconstructed are all zeros.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapping.importers.model import ImportedImage, ImportedModel
from mapping.importers.reading.photo_names import photo_names, photo_size
from mapping.importers.reading.poses import rotation_from_matrix
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
# From Bundler's camera axes (y up, -z forward) to ours, and of its image axes.
_OURS_FROM_BUNDLER = np.diag([1.0, -1.0, -1.0])
_LIST_WITH_FOCAL = re.compile(r"(?P<name>.*\S)\s+\d+\s+[0-9.eE+-]+")


@dataclass(frozen=True, slots=True, eq=False)
class _CameraBlock:
    """A reconstructed camera: f, k1, k2 and its pose in our axes."""

    line: int
    radial: tuple[float, float, float]
    pose: Pose


def read(path: Path, photos: Path | None = None) -> ImportedModel:
    """Read a Bundler model, version 0.3.

    The format has no image sizes: they are read from the photos, and cameras without a photo are
    left out. The world stays as it is in the file.

    Args:
        path: the file, or a folder with ``bundle.out`` or exactly one ``*.out``. The list of
            photos is ``NAME.list.txt`` or ``list.txt`` beside the file, or ``list.txt`` in the
            folder above or in ``photos``.
        photos: folder of photos; the list's folder by default.
    """
    path = _bundle_file(path)
    list_file = _list_file(path, photos)
    photos = list_file.parent if photos is None else photos
    named, num_focal = _read_list(list_file)
    num_cameras = len(named)
    with TextLines(path) as lines:
        num_points = _read_header(lines, num_cameras, list_file)
        cameras = [_read_camera(lines) for _ in range(num_cameras)]
        points: list[list[float]] = []
        colors: list[list[int]] = []
        rows: list[tuple[int, int, int, float, float]] = []
        for point in range(num_points):
            points.append(lines.next_numbers(3, "X Y Z of a point"))
            colors.append(_read_color(lines))
            rows += _read_view_list(lines, point, num_cameras)
        lines.end("its last point")

    names, notes = photo_names(named, list_file.parent, photos)
    sizes = [photo_size(photos / name) for name in names]
    kept = [index for index, size in enumerate(sizes) if size is not None]
    notes += tuple(note_on_absent(path, photos, names, kept))
    sensors: dict[str, Sensor] = {}
    images: list[ImportedImage] = []
    for index in kept:
        width, height = sizes[index] or (0, 0)
        camera, id_ = cameras[index], f"camera_{index}"
        sensors[id_] = _sensor(path, id_, camera, width, height)
        pose = None if camera is None else camera.pose
        images.append(ImportedImage(names[index], id_, index, pose))
    if num_lost := sum(cameras[index] is None for index in kept):
        notes += (f"{num_lost} of {len(kept)} photos were not reconstructed",)
    if num_focal:
        notes += (f"{num_focal} focal lengths in {list_file.name} are not read",)
    notes += _note_on_visualsfm([camera for camera in cameras if camera is not None])
    model = ImportedModel(
        sensors,
        tuple(images),
        photos,
        np.array(points, np.float64).reshape(-1, 3),
        np.array(colors, np.uint8).reshape(-1, 3),
        keypoints_type="sift",
        notes=notes,
    )
    measurements = kept_measurements(Measurements.from_rows(rows), kept, len(names))
    centers = np.array([sizes[index] for index in kept], np.float64).reshape(-1, 2) / 2
    return with_measurements(path, model, measurements, centers)


def _bundle_file(path: Path) -> Path:
    if not path.is_dir():
        return path
    found = sorted(path.glob("*.out"))
    named = [file for file in found if file.name == "bundle.out"] or found
    if len(named) != 1:
        raise refuse(
            "import.missing",
            "the folder does not hold exactly one Bundler file; name the file",
            field=str(path),
            expected="bundle.out, or one *.out",
            got=[file.name for file in found],
        )
    return named[0]


def _list_file(path: Path, photos: Path | None) -> Path:
    folder = path.parent
    candidates = [
        folder / f"{path.name}.list.txt",
        folder / f"{path.stem}.list.txt",
        folder / "list.txt",
        folder.parent / "list.txt",
        *([] if photos is None else [photos / "list.txt"]),
    ]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    raise refuse(
        "import.missing",
        "the list of photos is missing: one name per line, in the order of the cameras",
        field=str(path),
        expected=(str(candidate) for candidate in candidates),
    )


def _read_list(path: Path) -> tuple[list[tuple[str, str]], int]:
    """Return the photos and where they are named, and how many lines have a focal length."""
    named, num_focal = [], 0
    with TextLines(path) as lines:
        while (line := lines.next_or_none()) is not None:
            with_focal = _LIST_WITH_FOCAL.fullmatch(line)  # NAME 0 FOCAL, as Bundler writes it
            num_focal += with_focal is not None
            named.append((with_focal["name"] if with_focal else line, f"{path}:{lines.number}"))
    return named, num_focal


def _note_on_visualsfm(cameras: Sequence[_CameraBlock]) -> tuple[str, ...]:
    radial = [camera.radial for camera in cameras]
    if not any(k2 for _, _, k2 in radial) or any(k1 or abs(k2) > 1e-4 for _, k1, k2 in radial):
        return ()
    # Seen in models of one scene in both formats: k2 is the NVM's k divided by f squared.
    return (
        "k1 is 0 and k2 nearly so in all cameras, as VisualSFM writes them, whose distortion is "
        "not Bundler's: take its NVM file, where the distortion is read",
    )


def _read_header(lines: TextLines, num_named: int, list_file: Path) -> int:
    """Check the number of cameras; return the number of points."""
    header = lines.next("# Bundle file v0.3")
    if header != "# Bundle file v0.3":
        raise lines.error("this is not a Bundler file", expected="# Bundle file v0.3", got=header)
    fields = lines.next("the number of cameras and that of points").split()
    if len(fields) != 2:
        raise lines.error(
            "the line has the wrong number of fields",
            expected="2: cameras, points",
            got=len(fields),
        )
    num_cameras, num_points = (lines.to_integer(field, _MAX_COUNT) for field in fields)
    if num_cameras != num_named:
        raise lines.error(
            f"the list of photos ({list_file}) belongs to another file",
            expected=f"{num_named} cameras, one per photo of the list",
            got=num_cameras,
        )
    return num_points


def _read_camera(lines: TextLines) -> _CameraBlock | None:
    focal, k1, k2 = lines.next_numbers(3, "f k1 k2 of a camera")
    start = lines.number
    if focal < 0:
        raise lines.error("the focal length is not valid", expected="more than 0", got=focal)
    matrix = [lines.next_numbers(3, "a row of a rotation") for _ in range(3)]
    translation = np.array(lines.next_numbers(3, "a translation"))
    if focal == 0:
        return None
    rotation = rotation_from_matrix(matrix)
    if rotation is None:
        raise refuse(
            "import.line",
            "the matrix is not a rotation",
            field=f"{lines.path}:{start + 1}",
            expected="an orthonormal matrix",
            got=matrix,
        )
    pose = Pose(_OURS_FROM_BUNDLER @ rotation, _OURS_FROM_BUNDLER @ translation)
    return _CameraBlock(start, (focal, k1, k2), pose)


def _read_color(lines: TextLines) -> list[int]:
    fields = lines.next("R G B of a point").split()
    if len(fields) != 3:
        raise lines.error(
            "the line has the wrong number of fields", expected="3: R G B", got=len(fields)
        )
    return [lines.to_integer(field, 255) for field in fields]


def _read_view_list(
    lines: TextLines, point: int, num_cameras: int
) -> Sequence[tuple[int, int, int, float, float]]:
    expected = "count, and camera, feature, x, y of each view"
    count_field, *fields = lines.next(expected).split()
    count = lines.to_integer(count_field, _MAX_COUNT)
    if len(fields) != 4 * count:
        raise lines.error(
            "the line has the wrong number of fields",
            expected=f"{1 + 4 * count}: {expected}",
            got=len(fields) + 1,
        )
    return [
        (
            point,
            lines.to_integer(fields[start], num_cameras - 1),
            lines.to_integer(fields[start + 1], _MAX_COUNT),
            lines.to_number(fields[start + 2]),
            -lines.to_number(fields[start + 3]),  # y up
        )
        for start in range(0, len(fields), 4)
    ]


def _sensor(
    path: Path, sensor_id: str, camera: _CameraBlock | None, width: int, height: int
) -> Sensor:
    if camera is None:
        params = (UNKNOWN_CAMERA, str(width), str(height))
        return Sensor(sensor_id, "", "camera", params, None)
    focal, k1, k2 = camera.radial
    try:
        made = Camera("RADIAL", width, height, (focal, width / 2, height / 2, k1, k2))
    except InvalidInput as error:
        raise refuse(
            "import.line", error.message, field=f"{path}:{camera.line}", got=error.got
        ) from error
    return Sensor.with_camera(sensor_id, made)
