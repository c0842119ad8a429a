"""Checks of COLMAP models before pycolmap reads them.

pycolmap takes what a file cut short leaves in memory for numbers, and says of bad text neither
file nor line. Of a text model it gets a copy in which both read the same: pycolmap cuts names at
blanks, and drops the last image if the blank line of its keypoints is missing.

Formats: COLMAP's documentation, "Output Format".
"""

from __future__ import annotations

import mmap
import shutil
import struct
from codecs import BOM_UTF8
from pathlib import Path

import PIL.Image  # noqa: F401  Pillow saves PNGs only when it was imported before pycolmap
import pycolmap

from mapping.importers.reading.text_lines import TextLines
from visloc.errors import DatasetError, VislocError, refuse
from visloc.geometry import MAX_IMAGE_SIDE

FILES = ("cameras", "images", "points3D")
_OPTIONAL = ("rigs", "frames")
_MAX_ID = 2**32 - 1
# COLMAP's own name of a point that is none, as text.
_NO_POINT = {"-1", str(2**64 - 1)}

_MODELS = {
    int(kind.value): len(pycolmap.Camera.create_from_model_id(1, kind, 100.0, 100, 100).params)
    for name, kind in pycolmap.CameraModelId.__members__.items()
    if name != "INVALID"
}
_NUM_PARAMS = {
    name: _MODELS[int(kind.value)]
    for name, kind in pycolmap.CameraModelId.__members__.items()
    if name != "INVALID"
}


def has_model(folder: Path) -> bool:
    """Tell whether a folder holds a binary or text model."""
    return _suffix(folder) is not None


def check_model(folder: Path, copy: Path) -> dict[int, str] | None:
    """Check the files of a model that pycolmap would read: the binary ones, else the text.

    Args:
        copy: an existing folder that gets a text model as it was read, with ids for names.

    Returns:
        The images' names by id; None for a binary model, which pycolmap can read as it is.
    """
    if _suffix(folder) == ".bin":
        for name in (*FILES, *_OPTIONAL):
            path = folder / f"{name}.bin"
            if path.is_file():
                _check_binary(path)
        return None
    cameras = _check_cameras_text(_copied(folder, copy, "cameras"))
    images, names = _check_images_text(folder / "images.txt", cameras, copy / "images.txt")
    _check_points_text(_copied(folder, copy, "points3D"), images)
    for name in _OPTIONAL:
        if (folder / f"{name}.txt").is_file():
            _copied(folder, copy, name)
    return names


def _copied(folder: Path, copy: Path, name: str) -> Path:
    """Copy a text file without its byte order mark, or link to it; return the original."""
    path = folder / f"{name}.txt"
    try:
        with path.open("rb") as file:
            if file.read(len(BOM_UTF8)) == BOM_UTF8:
                with (copy / path.name).open("wb") as copied:
                    shutil.copyfileobj(file, copied)
            else:
                (copy / path.name).symlink_to(path.resolve())
    except OSError as error:
        raise refuse("import.unreadable", field=str(path), got=error.strerror) from error
    return path


def _suffix(folder: Path) -> str | None:
    for suffix in (".bin", ".txt"):
        if all((folder / f"{name}{suffix}").is_file() for name in FILES):
            return suffix
    return None


class _Bytes:
    """Walks through a binary file without leaving it."""

    def __init__(self, path: Path, content: mmap.mmap | bytes) -> None:
        self.path = path
        self._content = content
        self._position = 0

    def take(self, layout: str) -> tuple[int, ...]:
        """Read whole numbers."""
        start = self._position
        self.skip(struct.calcsize(layout))
        return struct.unpack_from(layout, self._content, start)

    def skip(self, size: int) -> None:
        """Step over bytes."""
        if size > len(self._content) - self._position:
            raise self.damaged("cut short")
        self._position += size

    def text(self) -> bytes:
        """Read a text that ends with a zero."""
        end = self._content.find(b"\0", self._position)
        if end < 0:
            raise self.damaged("cut short")
        text = self._content[self._position : end]
        self._position = end + 1
        return text

    def finish(self) -> None:
        """Refuse what comes after the end."""
        if self._position != len(self._content):
            raise self.damaged(f"{len(self._content) - self._position} bytes too many")

    def damaged(self, got: str) -> VislocError:
        return refuse(
            "import.colmap",
            "the file is damaged",
            field=str(self.path),
            expected="as many records as it announces, and nothing else",
            got=got,
        )


def _check_binary(path: Path) -> None:
    try:
        with path.open("rb") as file:
            if path.stat().st_size == 0:  # which cannot be mapped
                _walk(_Bytes(path, b""))
            else:
                with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
                    _walk(_Bytes(path, content))
    except OSError as error:
        raise refuse("import.unreadable", field=str(path), got=error.strerror) from error


def _walk(data: _Bytes) -> None:
    kind = data.path.stem
    names: set[bytes] = set()
    ids: set[int] = set()
    for _ in range(data.take("<Q")[0]):  # ends with an error where the file does
        if kind == "points3D":
            record_id, length = data.take("<Q35xQ")  # xyz, colour, error; then the track
            data.skip(8 * length)
        elif kind == "images":
            (record_id,) = data.take("<I60x")  # pose, camera
            name = data.text()
            if name in names:
                raise _twice(str(data.path), name.decode(errors="replace"))
            names.add(name)
            data.skip(24 * data.take("<Q")[0])
        elif kind == "cameras":
            record_id, model, width, height = data.take("<IiQQ")
            if model not in _MODELS or not 0 < width <= MAX_IMAGE_SIDE >= height > 0:
                raise data.damaged(f"camera {record_id}: model {model}, {width} x {height}")
            data.skip(8 * _MODELS[model])
        elif kind == "rigs":
            record_id, num_sensors = data.take("<II")
            for index in range(num_sensors):
                data.skip(8)
                if index and data.take("<B")[0]:  # the first is the reference, without a pose
                    data.skip(56)
        else:
            (record_id,) = data.take("<I60x")  # rig, pose
            data.skip(16 * data.take("<I")[0])
        if record_id in ids:
            raise data.damaged(f"two records of id {record_id}")
        ids.add(record_id)
    data.finish()


class _ImageLines(TextLines):
    """Lines of ``images.txt``, where a blank one says that an image has no keypoints."""

    def next_line(self) -> str:
        """Return the next line, blank or not; nothing at the end of the file."""
        self.number += 1
        return self._file.readline()


def _check_cameras_text(path: Path) -> set[int]:
    cameras: set[int] = set()
    with TextLines(path) as lines:
        while (line := _next_record(lines)) is not None:
            fields = line.split()
            if len(fields) < 4:
                raise _bad(
                    lines,
                    "the line does not describe a camera",
                    "id, model, width, height, parameters",
                    line,
                )
            if fields[1] not in _NUM_PARAMS:
                raise refuse(
                    "camera.model",
                    field=f"{path}:{lines.number}",
                    expected=_NUM_PARAMS,
                    got=fields[1],
                    kind=DatasetError,
                )
            if len(fields) != 4 + _NUM_PARAMS[fields[1]]:
                raise refuse(
                    "camera.param_count",
                    field=f"{path}:{lines.number}",
                    expected=str(_NUM_PARAMS[fields[1]]),
                    got=len(fields) - 4,
                    kind=DatasetError,
                    model=fields[1],
                )
            for side in fields[2:4]:
                lines.to_integer(side, MAX_IMAGE_SIDE)
            for number in fields[4:]:
                lines.to_number(number)
            camera = lines.to_integer(fields[0], _MAX_ID)
            if camera in cameras:
                raise _bad(lines, "two cameras have the same id", "every id once", fields[0])
            cameras.add(camera)
    return cameras


def _check_images_text(
    path: Path, cameras: set[int], copy: Path
) -> tuple[dict[int, int], dict[int, str]]:
    """Copy the file with ids for names; return the numbers of keypoints, and names, by id."""
    images: dict[int, int] = {}
    names: dict[int, str] = {}
    known: set[str] = set()
    with _ImageLines(path) as lines, copy.open("w", encoding="utf-8") as copied:
        while (line := _next_record(lines)) is not None:
            fields = line.split(maxsplit=9)
            if len(fields) != 10:
                raise _bad(
                    lines,
                    "the line does not describe an image",
                    "id, qw qx qy qz, tx ty tz, camera, name",
                    fields[:10],
                )
            image = lines.to_integer(fields[0], _MAX_ID)
            for number in fields[1:8]:
                lines.to_number(number)
            if lines.to_integer(fields[8], _MAX_ID) not in cameras:
                raise _bad(
                    lines,
                    f"cameras.txt does not have the camera of image {fields[9]!r}",
                    f"one of {', '.join(map(str, sorted(cameras)[:10]))}",
                    fields[8],
                )
            if image in images:
                raise _bad(lines, "two images have the same id", "every id once", fields[0])
            if fields[9] in known:
                raise _twice(f"{path}:{lines.number}", fields[9])
            known.add(fields[9])
            names[image] = fields[9]
            keypoints = lines.next_line().split()
            if len(keypoints) % 3:
                raise _bad(
                    lines,
                    "the keypoints are not valid",
                    "x, y, point id of each; a blank line for none",
                    f"{len(keypoints)} fields",
                )
            images[image] = len(keypoints) // 3
            for index in range(0, len(keypoints), 3):
                lines.to_number(keypoints[index])
                lines.to_number(keypoints[index + 1])
                if keypoints[index + 2] not in _NO_POINT:
                    lines.to_integer(keypoints[index + 2], 2**63)
            copied.write(f"{' '.join(fields[:9])} {image}\n{' '.join(keypoints)}\n")
    return images, names


def _check_points_text(path: Path, images: dict[int, int]) -> None:
    points: set[int] = set()
    with TextLines(path) as lines:
        while (line := _next_record(lines)) is not None:
            fields = line.split()
            if len(fields) < 8 or len(fields) % 2:
                raise _bad(
                    lines,
                    "the line does not describe a point",
                    "id, x y z, r g b, error, pairs of image and keypoint",
                    f"{len(fields)} fields",
                )
            for number in (*fields[1:4], fields[7]):
                lines.to_number(number)
            for channel in fields[4:7]:
                lines.to_integer(channel, 255)
            point = lines.to_integer(fields[0], 2**63)
            if point in points:
                raise _bad(lines, "two points have the same id", "every id once", fields[0])
            points.add(point)
            for index in range(8, len(fields), 2):
                image = lines.to_integer(fields[index], _MAX_ID)
                keypoint = lines.to_integer(fields[index + 1], _MAX_ID)
                if keypoint >= images.get(image, 0):
                    raise _bad(
                        lines,
                        "images.txt does not have a keypoint of this point",
                        "an image and the index of one of its keypoints",
                        f"image {image}, keypoint {keypoint}",
                    )


def _next_record(lines: TextLines) -> str | None:
    while (line := lines.next_or_none()) is not None and line.startswith("#"):
        pass
    return line


def _bad(lines: TextLines, message: str, expected: str, got: object) -> VislocError:
    return refuse(
        "import.colmap", message, field=f"{lines.path}:{lines.number}", expected=expected, got=got
    )


def _twice(where: str, name: str) -> VislocError:
    return refuse("import.duplicate_image", field=where, got=name)
