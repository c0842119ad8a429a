"""A plain folder of photos: intrinsics and GPS from EXIF, no poses.

The photo's rank takes the place of a timestamp: by EXIF time if every photo has one, else by path.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Callable, Mapping, Set
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import ExifTags

from mapping.importers.films import is_live_photo, stems_of_photos
from mapping.importers.left_out import notes_on
from mapping.importers.model import ImportedImage, ImportedModel
from mapping.importers.reading.photo_names import natural_order
from mapping.importers.recognized import refuse_recognized
from mapping.methods.sparse.intrinsics import FROM_EXIF
from visloc.errors import InvalidInput, NotFound, TooLarge, VislocError, refuse
from visloc.geometry import Camera
from visloc.kapture import GnssRecord, Sensor
from visloc.kapture.dataset import UNKNOWN_CAMERA
from visloc.kapture.text import is_path_field
from visloc.photos.file_kinds import kind_of
from visloc.photos.formats import FORMATS, PNG_GREY, SUFFIXES, png_samples
from visloc.photos.reading import FILE_LIMITS, Photo, exif_text, read_exif, read_photo

_GNSS = "gnss"
# Some programs write words in place of the letters of EXIF.
_NORTH = {"N": 1, "S": -1, "NORTH": 1, "SOUTH": -1}
_EAST = {"E": 1, "W": -1, "EAST": 1, "WEST": -1}
# Above and below the sea; since EXIF 3.0, 0 and 1 are the ellipsoid, and 2 and 3 the sea.
_ALTITUDE_SIGNS: dict[float | None, int] = {0: 1, 1: -1, 2: 1, 3: -1}
# Beside what begins with a dot: what Windows, macOS and network storage put among photos.
_SYSTEM_NAMES = {"thumbs.db", "desktop.ini", "@eadir", "__macosx", "$recycle.bin"}
_SYSTEM = "hidden, or of the operating system"
_LINKED = "links out of the folder and linked folders are not followed"
_RENAME = f"photos whose names do not end in {', '.join(sorted(SUFFIXES))}: rename them"
_UNSTORABLE = (
    "a dataset cannot store names with commas, backslashes, tabs, line breaks, blanks at an end or "
    "bytes that are not UTF-8: rename them"
)
_LIVE = "films that a phone took around photos: the photos are used"
_DEPTH, _FEW_LEVELS = "depth maps, grey of 16 bits", "masks or maps of confidence, not photos"
_LEAST_LEVELS = 4  # of a grey PNG that is a photo
# What Pillow raises on malformed EXIF beside giving none; found by fuzzing ``photos.reading``.
_MALFORMED = (
    *(OSError, SyntaxError, ValueError, TypeError, KeyError, IndexError, AttributeError),
    *(EOFError, OverflowError, ZeroDivisionError, RuntimeError),
)


@dataclass(frozen=True, slots=True)
class _Found:
    """A readable photo.

    Attributes:
        name: path relative to the folder.
        camera: make and model; may be empty.
        focal_length_px: from EXIF; None without.
        width: of the stored pixels.
        height: of the stored pixels.
        taken: EXIF time, as text that sorts; None without.
        fix: longitude, latitude in degrees; None without; why it cannot be used.
        altitude_m: above sea level; None without.
        dop: dilution of precision, 0 when unknown.
        doubt: why it is no photo if there are others beside it; None for a photo.
    """

    name: str
    camera: str
    focal_length_px: float | None
    width: int
    height: int
    taken: str | None
    fix: tuple[float, float] | str | None
    altitude_m: float | None
    dop: float
    doubt: str | None


@dataclass(slots=True)
class _Files:
    """The files of a folder, by path relative to it.

    Attributes:
        photos: those that may be photos, in the natural order of their names.
        left_out: the others by reason, as in ``ImportedModel``.
    """

    photos: list[str] = field(default_factory=list)
    left_out: dict[str, list[str]] = field(default_factory=dict)

    def leave_out(self, name: str, reason: str) -> None:
        self.left_out.setdefault(reason, []).append(name)


def read(
    path: Path, photos: Path | None = None, progress: Callable[[int, int], None] | None = None
) -> ImportedModel:
    """Read a folder of photos and its subfolders.

    Linked folders, and links out of the folder, are not followed. Photos of the same maker, model,
    focal length and size share a camera: SIMPLE_RADIAL if EXIF gives the focal length, else of
    unknown intrinsics. ``left_out`` of the model lists unused files with the reason.
    """
    if photos is not None:
        raise refuse(
            "import.photos",
            "a folder of photos does not take a second folder of photos",
            field="--photos",
            expected="only PATH",
            got=str(photos),
        )
    if path.is_file():
        raise _not_a_folder(path)
    if not path.is_dir():
        raise refuse(
            "import.missing",
            "there is no such folder",
            field=str(path),
            expected="a folder of photos",
            kind=NotFound,
        )
    files = _files_in(path)
    found = _read_photos(path, files, progress or (lambda _done, _total: None))
    if not found:
        raise refuse(
            "import.empty",
            "; ".join(["the folder holds no readable photo", *notes_on(files.left_out)]),
            field=str(path),
            expected=f"photos of {FORMATS}",
        )
    notes = _sort_by_time(found)
    cameras = _cameras(found)
    gnss = _gnss(found, notes)
    sensors = {sensor.id: sensor for sensor in cameras.values()}
    if gnss:
        sensors[_GNSS] = Sensor(_GNSS, "EXIF", "gnss", ("EPSG:4326",), None)
    if unknown := sum(photo.focal_length_px is None for photo in found):
        notes.append(
            f"{unknown} of {len(found)} photos do not tell their focal length: those of one camera "
            "and size count as not zoomed"
        )
    return ImportedModel(
        sensors=sensors,
        images=tuple(
            ImportedImage(photo.name, cameras[_camera_key(photo)].id, rank, None)
            for rank, photo in enumerate(found)
        ),
        photos=path,
        gnss=gnss,
        notes=tuple(notes),
        left_out=files.left_out,
    )


def _sort_by_time(found: list[_Found]) -> list[str]:
    """Sort the photos by their EXIF time where all have one; else say why not."""
    dated = [photo for photo in found if photo.taken is not None]
    if len(dated) == len(found):
        found.sort(key=lambda photo: (photo.taken or "", natural_order(photo.name)))
    elif dated:
        return [
            f"{len(found) - len(dated)} photos have no EXIF time: the order is that of the names"
        ]
    return []


def _read_photos(path: Path, files: _Files, progress: Callable[[int, int], None]) -> list[_Found]:
    """Read what the photos tell of themselves; leave out those that cannot be read."""
    found = []
    for done, name in enumerate(files.photos):
        progress(done, len(files.photos))
        try:
            found.append(_read_photo(path, name))
        except InvalidInput as error:
            files.leave_out(name, _reason(error))
    progress(len(files.photos), len(files.photos))
    photos = [photo for photo in found if photo.doubt is None]
    if not photos:
        return found
    for photo in found:
        if photo.doubt is not None:
            files.leave_out(photo.name, photo.doubt)
    return photos


def _not_a_folder(file: Path) -> VislocError:
    kind = kind_of(file)
    if kind is None:
        advice = "name the folder that it lies in"
    elif kind.is_read:
        advice = "a map takes several photos: name the folder that they lie in"
    else:
        advice = kind.refusal
    return refuse(
        "import.folder",
        field=str(file),
        got="a file" if kind is None else f"a file, {kind.name}",
        advice=advice,
    )


def _files_in(folder: Path) -> _Files:
    """Find every file in a folder and the folders in it."""
    inside = Path(os.path.realpath(folder))  # unlike Path.resolve, silent on links in a circle
    found = _Files()

    def unreadable(error: OSError) -> None:
        name = Path(error.filename).relative_to(folder).as_posix()
        found.leave_out(f"{name}/", f"folders that cannot be read: {error.strerror}")

    for where, folders, files in os.walk(folder, onerror=unreadable):
        refuse_recognized(Path(where))  # its depth and confidence would become photos
        entered = []
        for name in sorted(folders):
            path = Path(where) / name
            if _is_of_system(name):
                found.leave_out(f"{path.relative_to(folder).as_posix()}/", _SYSTEM)
            elif path.is_symlink():
                found.leave_out(f"{path.relative_to(folder).as_posix()}/", _LINKED)
            else:
                entered.append(name)
        folders[:] = entered
        stems = stems_of_photos(files)
        for file in sorted(files):
            path = Path(where) / file
            name = path.relative_to(folder).as_posix()
            reason = _why_not_read(path, inside, stems)
            if reason is None and not is_path_field(name):
                reason = _UNSTORABLE
            if reason is None:
                found.photos.append(name)
            else:
                found.leave_out(name, reason)
    found.photos.sort(key=natural_order)
    return found


def _is_of_system(name: str) -> bool:
    return name.startswith(".") or name.lower() in _SYSTEM_NAMES


def _why_not_read(path: Path, inside: Path, stems: Set[str]) -> str | None:
    """Return why a file is not read as a photo; None for one that is to be read.

    Args:
        stems: of the photos beside it.
    """
    if _is_of_system(path.name):
        return _SYSTEM
    if path.is_symlink() and not Path(os.path.realpath(path)).is_relative_to(inside):
        return _LINKED
    if path.exists() and not path.is_file():  # reading from a pipe would wait for ever
        return "neither files nor folders"
    if path.suffix.lower() in SUFFIXES:
        return None
    kind = kind_of(path)
    if kind is None:
        return "not photos"
    if is_live_photo(path, stems):
        return _LIVE
    return _RENAME if kind.is_read else kind.refusal


def _read_photo(folder: Path, name: str) -> _Found:
    path = folder / name
    try:
        with path.open("rb") as file:
            data = file.read(FILE_LIMITS.max_bytes + 1)
        photo = read_photo(data, FILE_LIMITS)  # decodes, as a build will
    except OSError as error:
        raise refuse("image.unreadable", field=name, got=error.strerror) from error
    except InvalidInput as error:
        raise error.about(name, InvalidInput) from error
    details, gps = _exif(data)
    taken = exif_text(details.get(ExifTags.Base.DateTimeOriginal)) or None
    if taken is not None:
        taken += "." + exif_text(details.get(ExifTags.Base.SubsecTimeOriginal))
    return _Found(
        name=name,
        camera=photo.camera_name,
        focal_length_px=photo.focal_length_px,
        width=photo.width,
        height=photo.height,
        taken=taken,
        fix=_fix(gps),
        altitude_m=_altitude(gps),
        dop=max(_number(gps.get(ExifTags.GPS.GPSDOP)) or 0.0, 0.0),
        doubt=_doubt(data, photo),
    )


def _doubt(data: bytes, photo: Photo) -> str | None:
    """Return what a grey PNG is that scanning apps write beside photos; None for a photo."""
    bits, colour = png_samples(data) or (0, None)
    if colour != PNG_GREY:
        return None
    if bits == 16:
        return _DEPTH
    return _FEW_LEVELS if len(np.unique(photo.rgb[..., 0])) < _LEAST_LEVELS else None


def _reason(error: InvalidInput) -> str:
    """Return why a photo cannot be read, in the same words for all photos of that trouble."""
    if isinstance(error, TooLarge):
        return f"{error.message}, expected {error.expected}"
    if error.code == "image.unreadable":
        return f"{error.message}: {error.got}"
    return error.message


def _camera_key(photo: _Found) -> tuple[object, ...]:
    return photo.camera, photo.focal_length_px, photo.width, photo.height


def _cameras(found: list[_Found]) -> dict[tuple[object, ...], Sensor]:
    cameras: dict[tuple[object, ...], Sensor] = {}
    for photo in found:
        key = _camera_key(photo)
        if key in cameras:
            continue
        sensor_id, width, height = f"camera{len(cameras) + 1}", photo.width, photo.height
        if photo.focal_length_px is None:
            params = (UNKNOWN_CAMERA, str(width), str(height))
            cameras[key] = Sensor(sensor_id, photo.camera, "camera", params, None)
        else:
            params_px = (photo.focal_length_px, width / 2, height / 2, 0.0)
            camera = Camera("SIMPLE_RADIAL", width, height, params_px)
            name = f"{photo.camera} {FROM_EXIF}".lstrip()
            cameras[key] = Sensor.with_camera(sensor_id, camera, name=name)
    return cameras


def _gnss(found: list[_Found], notes: list[str]) -> tuple[GnssRecord, ...]:
    fixes = []
    num_flat = 0
    unused = Counter(photo.fix for photo in found if isinstance(photo.fix, str))
    notes += [f"{num} GPS positions are not used: {why}" for why, num in sorted(unused.items())]
    for rank, photo in enumerate(found):
        if photo.fix is None or isinstance(photo.fix, str):
            continue
        num_flat += photo.altitude_m is None
        altitude = photo.altitude_m or 0.0
        fixes.append(GnssRecord(rank, _GNSS, *photo.fix, z=altitude, utc=0.0, dop=photo.dop))
    if num_flat:
        notes.append(f"{num_flat} GPS positions have no altitude that can be read: 0 was taken")
    return tuple(fixes)


_Tags = dict[int, object]


def _exif(data: bytes) -> tuple[_Tags, _Tags]:
    """Return the tags of a photo in the Exif part and of GPS; none if broken."""
    try:
        exif = read_exif(data)
        return dict(exif.get_ifd(ExifTags.IFD.Exif)), dict(exif.get_ifd(ExifTags.IFD.GPSInfo))
    except _MALFORMED:
        return {}, {}


def _number(value: object) -> float | None:
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def _fix(gps: _Tags) -> tuple[float, float] | str | None:
    """Return longitude and latitude (deg); None without; why they cannot be used."""
    tags = ExifTags.GPS
    if tags.GPSLongitude not in gps and tags.GPSLatitude not in gps:
        return None
    try:
        longitude = _degrees(gps.get(tags.GPSLongitude), gps.get(tags.GPSLongitudeRef), _EAST, 180)
        latitude = _degrees(gps.get(tags.GPSLatitude), gps.get(tags.GPSLatitudeRef), _NORTH, 90)
    except ValueError as error:
        return str(error)
    if (longitude, latitude) == (0.0, 0.0):
        return "they are 0, 0, which receivers write before they know"
    return longitude, latitude


def _degrees(value: object, letter: object, signs: Mapping[str, int], limit: float) -> float:
    """Return degrees of degrees, minutes, seconds and the letter of the hemisphere.

    Numbers at the end that are not there or 0/0 are 0: the one before them has decimals then.
    """
    letter = letter.decode("latin-1") if isinstance(letter, bytes) else letter
    sign = signs.get(exif_text(letter).upper())
    if sign is None:
        raise ValueError(f"the letter of the hemisphere ({'/'.join(signs)}) is missing or unknown")
    parts = [_number(part) for part in (value if isinstance(value, tuple) else (value,))]
    while parts and parts[-1] is None:
        parts.pop()
    numbers = [number for number in parts if number is not None]
    total = sum(number / 60.0**power for power, number in enumerate(numbers))
    if (
        not 1 <= len(parts) == len(numbers) <= 3
        or min(numbers) < 0
        or max(numbers[1:], default=0) > 60
        # Decimals of a number, and then what they stand for once more.
        or any(number % 1 and any(numbers[i + 1 :]) for i, number in enumerate(numbers))
        or total > limit
    ):
        raise ValueError("they are not degrees, minutes and seconds within the range of each")
    return sign * total


def _altitude(gps: _Tags) -> float | None:
    altitude = _number(gps.get(ExifTags.GPS.GPSAltitude))
    reference = gps.get(ExifTags.GPS.GPSAltitudeRef, 0)
    if isinstance(reference, bytes):
        reference = int.from_bytes(reference, "big")
    sign = _ALTITUDE_SIGNS.get(_number(reference))
    return None if altitude is None or sign is None else sign * altitude
